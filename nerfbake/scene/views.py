"""Pictures with cameras, to which a field is fitted and with which it is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.parallel import in_order
from nerfbake.kernels.soundness import plural
from nerfbake.scene.base import MAX_WORLD, Scene
from nerfbake.scene.camera import Cameras
from nerfbake.scene.packed_pictures import PackedPicture, PackedPictures, Pixels

PLAIN = 16  # of 255: largest difference of a background pixel from the background colour in any channel


@dataclass(frozen=True, eq=False, repr=False)
class Views(Scene):
    """Cameras with their pictures.

    cameras     each in the size of its picture
    pictures    (H, W, 4) uint8 of each camera: straight sRGB colour and alpha, as in files; they are kept compressed
                in memory, and decompressed at every access
    background  sRGB, 0..1: the colour behind the object; pictures with alpha are composited over it
    masked      True: alpha separates the object from the background, or with scenery what is used from what is ignored;
                False: alpha is 255 everywhere
    scenery     True: all pixels with alpha 255 show something that is fitted, also what stands behind the object
    rough       True: alpha comes from masks that may cut off parts of the object

    >>> import numpy as np
    >>> from nerfbake import Camera, Cameras, Views
    >>> cameras = Cameras((Camera(4, 3, 5.0, np.eye(4), "front"),))
    >>> print(Views(cameras, (np.zeros((3, 4, 4), np.uint8),), (1.0, 1.0, 1.0), True))
    1 picture with alpha
    """

    cameras: Cameras
    pictures: Sequence[Pixels]
    background: tuple[float, float, float]
    masked: bool
    scenery: bool = False
    rough: bool = False

    def __post_init__(self) -> None:
        if len(self.pictures) != len(self.cameras.cameras):
            found = f"are {len(self.pictures):,}"
            raise InvalidScene(Problem("pictures", found, f"{len(self.cameras.cameras):,}, one per camera"))
        pictures = PackedPictures.of(self.pictures)
        object.__setattr__(self, "pictures", pictures)
        for camera, picture in zip(self.cameras.cameras, pictures.packed, strict=True):
            shape, (own_shape, dtype) = (camera.height, camera.width, 4), picture.form
            if own_shape != shape or dtype != np.uint8:
                found = f"has shape {own_shape}, dtype {dtype}"
                raise InvalidScene(Problem(f"picture {camera.name}".strip(), found, f"{shape} uint8"))

    def __str__(self) -> str:
        return plural(len(self.pictures), "picture") + (
            " with scenery" if self.scenery else " with alpha" if self.masked else ""
        )

    def take(self, numbers: Sequence[int]) -> Views:
        """These views alone, in this order; the pictures are shared."""
        return replace(
            self, cameras=self.cameras.take(numbers), pictures=PackedPictures.of(self.pictures).take(numbers)
        )

    def reduced(self, factor: int) -> Views:
        """These views with pictures that are smaller by a whole factor."""
        if factor == 1:
            return self
        from nerfbake.kernels.picture.reduction import reduced_picture  # here, because it imports numba

        cameras = replace(self.cameras, cameras=tuple(camera.reduced(factor) for camera in self.cameras.cameras))
        pictures = PackedPictures(PackedPicture(reduced_picture(picture, factor)) for picture in self.pictures)
        return replace(self, cameras=cameras, pictures=pictures)

    def photograph(self, number: int) -> npt.NDArray[np.float32]:
        """A picture composited over the background, (H, W, 3) sRGB in 0..1."""
        pixels = self.pictures[number]
        alpha = pixels[..., 3:] / np.float32(255)
        colour = pixels[..., :3] / np.float32(255)
        return np.asarray(colour * alpha + (1 - alpha) * np.array(self.background, np.float32), np.float32)

    def used(self, number: int) -> npt.NDArray[np.bool_]:
        """(H, W) bool: the pixels of a picture that are fitted and measured: with scenery, those with alpha 255."""
        pixels = self.pictures[number]
        return pixels[..., 3] == 255 if self.scenery else np.ones(pixels.shape[:2], bool)

    def side(self) -> float:
        """The square root of the mean number of pixels that show the object, or scenery."""
        shown = in_order(partial(self._shown, number) for number in range(len(self.pictures)))
        return float(np.sqrt(sum(shown) / max(len(self.pictures), 1)))

    def _shown(self, number: int) -> int:
        behind = self.behind(number)
        return behind.size - int(np.count_nonzero(behind))

    def behind(self, number: int) -> npt.NDArray[np.bool_]:
        """(H, W) bool: the pixels of a picture that show only background: alpha 0, or its plain colour."""
        pixels = self.pictures[number]
        return pixels[..., 3] == 0 if self.masked else near_colour(pixels, self.background)


def world_box(corners: Sequence[float]) -> npt.NDArray[np.float64]:
    """(2, 3) lowest and highest corner of the box x0, y0, z0, x1, y1, z1 in the world. Raises InvalidScene."""
    box = np.array(corners, np.float64).reshape(-1)
    if box.shape != (6,) or not (np.abs(box) <= MAX_WORLD).all() or not (box[:3] < box[3:]).all():
        found = f"is {', '.join(f'{value:g}' for value in box.tolist())}"
        raise InvalidScene(Problem("box", found, "x0, y0, z0, x1, y1, z1, each below its opposite"))
    return box.reshape(2, 3)


def near_colour(pixels: npt.NDArray[np.uint8], colour: tuple[float, float, float]) -> npt.NDArray[np.bool_]:
    """(..., 4) uint8 -> (...) bool: the pixels that differ from an sRGB colour (0..1) by at most PLAIN."""
    plain = np.rint(255 * np.array(colour)).astype(np.int16)
    return np.asarray((np.abs(pixels[..., :3] - plain) <= PLAIN).all(axis=-1))
