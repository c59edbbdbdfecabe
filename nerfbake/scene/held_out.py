"""Held-out pixels: pixels of photographs that a scene was not fitted to. Later steps measure their loss with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.image import WHITE, Image

RAYS = 500_000  # enough to measure 0.1 dB with a precision of 0.01 dB
MAX_EVERY = 1 << 16


@dataclass(frozen=True, eq=False, repr=False)
class HeldOut(CompactRepr):
    """Every k-th pixel of every k-th row of photographs, starting with the first.

    cameras     each in its photograph's size; `samples` is the number of rays along each edge of a pixel
    pixels      (h, w, 3) uint8 for each camera: sRGB over the background, h = ceil(height / every)
    every       k
    background  sRGB, 0..1

    >>> import numpy as np
    >>> from nerfbake import Camera, Cameras, HeldOut
    >>> camera = Camera(4, 3, 5.0, np.eye(4), "front")
    >>> print(HeldOut.of(Cameras((camera,)), [np.zeros((3, 4, 3))]))
    12 pixels of 1 view
    """

    cameras: Cameras
    pixels: tuple[npt.NDArray[np.uint8], ...]
    every: int = 1
    background: tuple[float, float, float] = WHITE

    def __post_init__(self) -> None:
        if not 1 <= self.every <= MAX_EVERY:
            raise InvalidScene(Problem("every", f"is {self.every}", f"1 to {MAX_EVERY:,}"))
        if len(self.background) != 3 or not all(0 <= part <= 1 for part in self.background):
            raise InvalidScene(Problem("background", f"is {self.background}", "three numbers, 0 to 1"))
        if len(self.pixels) != len(self.cameras.cameras):
            allowed = f"{len(self.cameras.cameras)}, one per camera"
            raise InvalidScene(Problem("truth", f"has {len(self.pixels)} pictures", allowed))
        for camera, pixels in zip(self.cameras.cameras, self.pixels, strict=True):
            if pixels.shape != (*thinned_size(camera, self.every), 3) or pixels.dtype != np.uint8:
                found, allowed = f"are {pixels.shape} {pixels.dtype}", f"{(*thinned_size(camera, self.every), 3)} uint8"
                raise InvalidScene(Problem(f"pixels of {camera.name}".strip(), found, allowed))

    def __str__(self) -> str:
        views = len(self.pixels)
        count = sum(pixels.size // 3 for pixels in self.pixels)
        return f"{count:,} pixels of {views:,} view{'s' * (views != 1)}"

    @classmethod
    def of(
        cls,
        cameras: Cameras,
        photographs: Iterable[npt.NDArray[np.floating]],
        *,
        background: tuple[float, float, float] = WHITE,
    ) -> HeldOut:
        """Select pixels of photographs (H, W, 3), sRGB in 0..1 over the background.

        All pixels are kept if they take up to RAYS rays, else so many that they take RAYS to 4 RAYS. Raises
        InvalidScene if the number or the sizes of the photographs differ from those of the cameras.
        """
        total = sum(camera.width * camera.height for camera in cameras.cameras)
        every = min(max(1, int(cameras.samples * np.sqrt(total / RAYS))), MAX_EVERY)
        views, pixels = cameras.cameras, []
        for number, photograph in enumerate(photographs):
            if number < len(views) and photograph.shape[:2] != (views[number].height, views[number].width):
                found = f"has {photograph.shape[1]}x{photograph.shape[0]} pixels"
                allowed = f"{views[number].width}x{views[number].height}"
                raise InvalidScene(Problem(f"truth of {views[number].name}", found, allowed))
            pixels.append(np.rint(255 * photograph[::every, ::every].clip(0, 1)).astype(np.uint8))
        return cls(cameras, tuple(pixels), every, background)

    @classmethod
    def of_images(cls, cameras: Cameras, photographs: Iterable[Image]) -> HeldOut:
        """Like of(), for pictures, which are composited over white."""
        return cls.of(cameras, (image.over(WHITE).colour for image in photographs), background=WHITE)

    def looks(self) -> list[list[Camera]]:
        """For each view the cameras of its pixels, one for each ray of a pixel.

        The mean of their pictures equals the view at these pixels, except for the last bits.
        """
        N = self.cameras.samples
        parts = [(i + 0.5) / N for i in range(N)]
        return [[self._thinned(camera, x, y) for y in parts for x in parts] for camera in self.cameras.cameras]

    def _thinned(self, camera: Camera, x: float, y: float) -> Camera:
        """The camera of one ray per pixel, at x, y in 0..1 of the pixel."""
        height, width = thinned_size(camera, self.every)
        return replace(
            camera,
            width=width,
            height=height,
            focal=(camera.fx / self.every, camera.fy / self.every),
            centre=(0.5 + (camera.cx - x) / self.every, 0.5 + (camera.cy - y) / self.every),
        )


def thinned_size(camera: Camera, every: int) -> tuple[int, int]:
    """(h, w): the number of selected rows, and of selected pixels in a row."""
    return -(-camera.height // every), -(-camera.width // every)
