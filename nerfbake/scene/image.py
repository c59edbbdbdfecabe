"""Pictures with transparency and depth, depth maps, and animations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import MAX_EDGE, count_problem
from nerfbake.scene.base import MAX_WORLD, Scene, number_problems
from nerfbake.scene.compact_repr import notebook_png

WHITE = (1.0, 1.0, 1.0)
GAP = 4  # pixels between the pictures of a contact sheet


@dataclass(frozen=True, eq=False, repr=False)
class Image(Scene):
    """A rendered picture.

    colour  (H, W, 3) float32: sRGB in 0..1, composited over the background, or premultiplied by alpha if there is none
    alpha   (H, W) float32: opacity along the ray, 0..1
    depth   (H, W) float32: the expected distance at which the ray is absorbed, in world units; 0 if it meets nothing
    background  the sRGB colour that `colour` is composited over; None: the picture is transparent

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
        """The picture, for a notebook cell."""
        return notebook_png(self)

    def __str__(self) -> str:
        return f"image of {self.size[0]}x{self.size[1]}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return int(self.alpha.shape[1]), int(self.alpha.shape[0])

    def over(self, background: tuple[float, float, float]) -> Image:
        """The picture composited over a background; itself if it has one."""
        if self.background is not None:
            return self
        colour = self.colour + (1 - self.alpha[..., None]) * np.array(background, np.float32)
        return replace(self, colour=colour, background=background)

    def reduced(self, factor: int) -> Image:
        """The means of factor x factor pixels, without the rows and columns that are left over. It has no depth."""
        height, width = (edge // factor for edge in self.alpha.shape)

        def means(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
            total = np.zeros((height, width, *values.shape[2:]), np.float32)
            for y in range(factor):
                for x in range(factor):
                    total += values[y : height * factor : factor, x : width * factor : factor]
            return np.asarray(total / np.float32(factor * factor), np.float32)

        alpha = means(self.alpha)
        return Image(means(self.colour), alpha, np.zeros_like(alpha), self.background)

    @staticmethod
    def tiled(images: Sequence[Image], *, columns: int | None = None) -> Image:
        """A contact sheet: rows from the top left, with cells as large as the largest image.

        columns: by default, the number that makes the sheet nearly square. The first image's background (or none) fills
        the gaps; transparent images are composited over it. The sheet has no depth.
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
        """The alpha channel as a picture, white where the scene is opaque."""
        return replace(self, colour=np.repeat(self.alpha[..., None], 3, axis=2), background=(0.0, 0.0, 0.0))

    @property
    def pixels(self) -> npt.NDArray[np.uint8]:
        """(H, W, 3) uint8, or (H, W, 4) with straight alpha if there is no background."""
        if self.background is not None:
            return _bytes(self.colour)
        straight = self.colour / np.maximum(self.alpha, 1e-6)[..., None]
        return _bytes(np.concatenate([straight, self.alpha[..., None]], axis=2))


def _bytes(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    scaled = np.clip(values, 0, 1)
    scaled *= 255
    return np.rint(scaled, out=scaled).astype(np.uint8)


@dataclass(frozen=True, eq=False, repr=False)
class Depth(Scene):
    """distance (H, W) float32: along each pixel's ray, in world units; 0 if the ray meets nothing.

    >>> import numpy as np
    >>> from nerfbake import Depth
    >>> print(Depth(np.array([[0.0, 1.5, 2.5]], np.float32)))
    depth of 3x1, 1.5 to 2.5 world units
    """

    distance: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = self.distance.shape
        if len(shape) != 2 or self.distance.dtype != np.float32 or not all(1 <= edge <= MAX_EDGE for edge in shape):
            found = f"has shape {shape}, dtype {self.distance.dtype}"
            raise InvalidScene(Problem("depth", found, f"(H, W) float32, 1 to {MAX_EDGE:,} pixels per edge"))
        memory.require("depth", self.distance.size)
        for problem in number_problems("depth", self.distance, most=MAX_WORLD):
            raise InvalidScene(problem)
        for problem in count_problem("depth", self.distance < 0, self.distance, "a distance from 0"):
            raise InvalidScene(problem)

    def __str__(self) -> str:
        met = self.distance[self.distance > 0]
        reach = f", {met.min():.4g} to {met.max():.4g} world units" if len(met) else ", nothing met"
        return f"depth of {self.distance.shape[1]}x{self.distance.shape[0]}{reach}"


@dataclass(frozen=True, eq=False, repr=False)
class Animation(Scene):
    """frames: pictures of one size, all transparent or none. The animation loops.

    >>> from nerfbake import Animation, build_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> views = orbit_cameras(field, frames=3, width=16, height=12).cameras
    >>> print(Animation(tuple(render_field(field, view) for view in views)))
    animation of 3 pictures of 16x12
    """

    frames: tuple[Image, ...]

    def __post_init__(self) -> None:
        if not self.frames:
            raise InvalidScene(Problem("animation", "has no pictures", "at least one"))
        for number, frame in enumerate(self.frames):
            if frame.size != self.size:
                found = f"has {frame.size[0]}x{frame.size[1]} pixels"
                raise InvalidScene(
                    Problem(f"picture {number}", found, f"{self.size[0]}x{self.size[1]}, like the first")
                )
            if (frame.background is None) != self.transparent:
                raise InvalidScene(Problem(f"picture {number}", "differs in transparency", "all transparent or none"))

    def __str__(self) -> str:
        return f"animation of {len(self.frames)} pictures of {self.size[0]}x{self.size[1]}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.frames[0].size

    @property
    def transparent(self) -> bool:
        return self.frames[0].background is None
