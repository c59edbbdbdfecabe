"""A picture with its transparency and depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene
from nerfbake.scene.shown import encoded

WHITE = (1.0, 1.0, 1.0)
GAP = 4  # pixels between the pictures of a contact sheet


@dataclass(frozen=True, eq=False, repr=False)
class Image(Scene):
    """What a camera sees.

    colour  (H, W, 3) float32: sRGB in 0..1, already over the background, or premultiplied by alpha where there is none
    alpha   (H, W) float32: what the ray has lost to the scene, 0..1
    depth   (H, W) float32: the expected distance at which it is lost, in world units; 0 where nothing is met
    background  'colour' is over this sRGB colour; None: the picture is transparent

    >>> import numpy as np
    >>> from nerfbake import Image
    >>> grey, whole = np.full((2, 4, 3), 0.5, np.float32), np.ones((2, 4), np.float32)
    >>> image = Image(grey, whole, 3 * whole)
    >>> image.size, image.pixels.dtype
    ((4, 2), dtype('uint8'))
    """

    colour: npt.NDArray[np.float32]
    alpha: npt.NDArray[np.float32]
    depth: npt.NDArray[np.float32]
    background: tuple[float, float, float] | None = WHITE

    def __post_init__(self) -> None:
        if self.colour.ndim != 3 or self.colour.shape[2] != 3 or self.alpha.shape != self.colour.shape[:2]:
            found = f"has colours of shape {self.colour.shape}, alpha of {self.alpha.shape}"
            raise InvalidScene(Problem("image", found, "(H, W, 3) and (H, W)"))

    def _repr_png_(self) -> bytes:
        """Itself, in the cell of a notebook."""
        return encoded(self)

    def __str__(self) -> str:
        return f"image of {self.size[0]}x{self.size[1]}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return int(self.alpha.shape[1]), int(self.alpha.shape[0])

    def over(self, background: tuple[float, float, float]) -> Image:
        """The same picture over a background; itself where it has one."""
        if self.background is not None:
            return self
        colour = self.colour + (1 - self.alpha[..., None]) * np.array(background, np.float32)
        return replace(self, colour=colour, background=background)

    @staticmethod
    def tiled(images: Sequence[Image], *, columns: int | None = None) -> Image:
        """A contact sheet: rows from the top left, in cells as large as the largest of the images.

        columns: as many as make the sheet nearly square, unless they are given. The first image's background (or
        none) shows between them; a transparent image among others is put over it. The sheet has no depth.
        """
        width, height = (max(image.size[axis] for image in images) for axis in (0, 1))
        columns = columns or min(len(images), math.ceil(math.sqrt(len(images) * height / width)))
        rows = math.ceil(len(images) / columns)
        shape = (rows * (height + GAP) - GAP, columns * (width + GAP) - GAP)
        background = images[0].background
        colour = np.full((*shape, 3), background or (0.0, 0.0, 0.0), np.float32)
        alpha = np.zeros(shape, np.float32)
        for i, image in enumerate(images):
            x, y = i % columns * (width + GAP), i // columns * (height + GAP)
            cell = slice(y, y + image.size[1]), slice(x, x + image.size[0])
            colour[cell] = (image if background is None else image.over(background)).colour
            alpha[cell] = image.alpha
        return Image(colour, alpha, np.zeros_like(alpha), background)

    @property
    def mask(self) -> Image:
        """The alpha as a picture, white where nothing shines through."""
        return replace(self, colour=np.repeat(self.alpha[..., None], 3, axis=2), background=(0.0, 0.0, 0.0))

    @property
    def pixels(self) -> npt.NDArray[np.uint8]:
        """(H, W, 3) uint8, or (H, W, 4) with straight alpha where there is no background."""
        if self.background is not None:
            return _bytes(self.colour)
        straight = self.colour / np.maximum(self.alpha, 1e-6)[..., None]
        return _bytes(np.concatenate([straight, self.alpha[..., None]], axis=2))


def _bytes(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    scaled = np.clip(values, 0, 1)
    scaled *= 255
    return np.rint(scaled, out=scaled).astype(np.uint8)
