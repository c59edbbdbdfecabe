"""A camera in OpenGL's axes: x to the right, y up, looking down -z; pixel centres at halves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.affine import turned
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.soundness import MAX_EDGE, plural
from nerfbake.scene.base import MAX_WORLD, Scene
from nerfbake.scene.lens import Lens, Raster, blind_rim, pixel_looks
from nerfbake.scene.shown import Shown

FOCAL_LENGTHS = (1e-6, 1e9)  # pixels
MAX_AXIS = 1e6  # of a pose's axes, whose length nothing depends on
MIN_VOLUME = 1e-12  # of the box that they span
ORTHOGONAL = 1e-3  # how far a rotation's axes may be from it, for a writer's rounding
WORLD = np.eye(3)
MAX_SAMPLES = 8  # rays along an edge of a pixel
PICTURE_BYTES = 72  # a pixel of a picture that is kept, put into a sheet, and made into bytes (72 measured)


@dataclass(frozen=True, eq=False, repr=False)
class Camera(Shown):
    """width, height in pixels; pose (4, 4) float64 is camera to world; name is the frame's.

    focal   in pixels: one for both axes, or (fx, fy)
    centre  (cx, cy), where the optical axis meets the picture, in pixels from its upper left corner; None: the middle
    lens    what it does beside perspective; None: a pinhole
    picture  what it took: a path in its capture's folder, whose ending may be missing; '' where none is known

    >>> import numpy as np
    >>> from nerfbake import Camera
    >>> camera = Camera(4, 3, 5.0, np.eye(4), "front")
    >>> origin, directions = camera.rays()
    >>> directions.shape
    (12, 3)
    """

    width: int
    height: int
    focal: float | tuple[float, float]
    pose: npt.NDArray[np.float64]
    name: str = ""
    centre: tuple[float, float] | None = None
    lens: Lens | None = None
    picture: str = ""

    def __post_init__(self) -> None:
        if not (1 <= self.width <= MAX_EDGE and 1 <= self.height <= MAX_EDGE):
            raise self._wrong(f"has {self.width}x{self.height} pixels", f"1 to {MAX_EDGE:,} an edge")
        for focal in (self.fx, self.fy):
            if not FOCAL_LENGTHS[0] <= focal <= FOCAL_LENGTHS[1]:
                raise self._wrong(f"has focal length {focal:g}", f"{FOCAL_LENGTHS[0]:g} to {FOCAL_LENGTHS[1]:g} pixels")
        if not (abs(self.cx) <= FOCAL_LENGTHS[1] and abs(self.cy) <= FOCAL_LENGTHS[1]):
            raise self._wrong(f"has its centre at {self.cx:g}, {self.cy:g}", f"up to {FOCAL_LENGTHS[1]:g} pixels away")
        if self.pose.shape != (4, 4):
            raise self._wrong(f"has a pose of shape {self.pose.shape}", "4 x 4 finite numbers")
        if found := _pose_problem(self.pose.tolist()):
            raise self._wrong(*found)

    def _wrong(self, found: str, allowed: str) -> InvalidScene:
        return InvalidScene(Problem(f"camera {self.name}".strip(), found, allowed))

    @property
    def fx(self) -> float:
        """Focal length across, in pixels."""
        return self.focal[0] if isinstance(self.focal, tuple) else self.focal

    @property
    def fy(self) -> float:
        """Focal length down, in pixels."""
        return self.focal[1] if isinstance(self.focal, tuple) else self.focal

    @property
    def cx(self) -> float:
        """Of the optical axis, pixels from the left edge."""
        return self.width / 2 if self.centre is None else self.centre[0]

    @property
    def cy(self) -> float:
        """Of the optical axis, pixels from the upper edge."""
        return self.height / 2 if self.centre is None else self.centre[1]

    def resized(self, width: int, height: int) -> Camera:
        """The same view in another number of pixels: the field of view across stays, and so does a pixel's shape."""
        focal = self.fx * width / self.width, self.fy * width / self.width
        centre = None
        if self.centre is not None:
            grown = width / self.width
            centre = width / 2 + (self.cx - self.width / 2) * grown, height / 2 + (self.cy - self.height / 2) * grown
        return replace(self, width=width, height=height, focal=focal, centre=centre)

    def part(self, columns: slice, rows: slice, *, finer: int = 1) -> Camera:
        """Some of the picture's pixels as a picture of their own, each divided into finer x finer."""
        width, height = (finer * (pixels.stop - pixels.start) for pixels in (columns, rows))
        centre = finer * (self.cx - columns.start), finer * (self.cy - rows.start)
        return replace(self, width=width, height=height, focal=(finer * self.fx, finer * self.fy), centre=centre)

    def require_memory(self, pixel_bytes: int) -> None:
        """Raises MemoryLimit if so many bytes for each pixel do not fit."""
        memory.require(f"a picture of {self.width}x{self.height} pixels", pixel_bytes * self.width * self.height)

    def rays(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The camera's place (3,) and a unit direction for each pixel (height * width, 3), rows from the top.

        Raises InvalidScene where the lens shows nothing at a pixel.
        """
        right, up, back = self.pose[:3, :3].T
        if self.lens is None or not self.lens.bends:
            x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
            y = -(np.arange(self.height) + 0.5 - self.cy) / self.fy
            directions = (x[:, None] * right - back) + (y[:, None] * up)[:, None]
        else:
            looks, fine = pixel_looks(self._seen, self.lens)
            if not fine.all():
                raise InvalidScene(self._no_look(int(np.argmin(fine)), int((~fine).sum())))
            directions = np.empty_like(looks)
            for axis, (r, u, b) in enumerate(zip(right, up, back, strict=True)):
                directions[..., axis] = looks[..., 0] * r - looks[..., 1] * u - looks[..., 2] * b
        across, down, along = np.moveaxis(directions, -1, 0)
        directions /= np.sqrt(across * across + down * down + along * along)[..., None]
        return self.pose[:3, 3], directions.reshape(-1, 3)

    def lens_problems(self) -> list[Problem]:
        """What rays() would raise, told from the picture's rim: what is seen there, is seen inside it, too."""
        if self.lens is None or not self.lens.bends:
            return []
        pixel = blind_rim(self._seen, self.lens)
        return [] if pixel is None else [self._no_look(pixel, 1)]

    @property
    def _seen(self) -> Raster:
        return Raster(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def _no_look(self, pixel: int, times: int) -> Problem:
        assert self.lens is not None
        y, x = divmod(pixel, self.width)
        found = f"shows nothing at pixel {x}, {y}: its {self.lens.model} distortion cannot be undone there"
        return Problem(f"camera {self.name}".strip(), found, "a lens that covers the picture", times)


@dataclass(frozen=True, eq=False, repr=False)
class Cameras(Scene):
    """The cameras of a capture, in order.

    dialect  whose conventions their file follows; '' for cameras that were made and not read
    source   the file or files of a folder that they were read from; '' for a file of its own
    notes    what was taken for granted, a line each
    samples  pictures are to have samples x samples rays a pixel, 1 to 8: as their photographs were averaged

    >>> import numpy as np
    >>> from nerfbake import Camera, Cameras
    >>> cameras = Cameras((Camera(4, 3, 5.0, np.eye(4), "front"),))
    >>> print(cameras)
    1 camera
    """

    cameras: tuple[Camera, ...]
    dialect: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    samples: int = 1

    def __post_init__(self) -> None:
        require_samples(self.samples)
        if not self.cameras:
            raise InvalidScene(Problem("frames", "are an empty list", "at least one camera"))

    def __str__(self) -> str:
        return plural(len(self.cameras), "camera") + (f" ({self.dialect})" if self.dialect else "")

    @property
    def rays_told(self) -> str:
        """What is said of their pictures where they are to have more than one ray a pixel."""
        return rays_told(self.samples)

    def chosen(self, *, size: tuple[int, int] | None = None, samples: int | None = None) -> Cameras:
        """The same cameras with pictures of another size (W, H) and another number of samples, where they are given."""
        cameras = self.cameras if size is None else tuple(camera.resized(*size) for camera in self.cameras)
        return replace(self, cameras=cameras, samples=self.samples if samples is None else samples)

    @property
    def names(self) -> list[str]:
        return [camera.name for camera in self.cameras]

    def fitting(self, pictures: Iterable[Any]) -> Cameras:
        """The same cameras, each for pictures as large as its own of these, which have a `size` (W, H)."""
        sized = tuple(view.resized(*picture.size) for view, picture in zip(self.cameras, pictures, strict=True))
        return replace(self, cameras=sized)

    def value_problems(self) -> list[Problem]:
        """Poses that are no rotation, and lenses that do not cover their picture."""
        turns = np.stack([camera.pose[:3, :3] for camera in self.cameras])
        gram = (turns[:, :, :, None] * turns[:, :, None]).sum(axis=1)
        handed = (np.cross(turns[:, 0], turns[:, 1]) * turns[:, 2]).sum(axis=1)
        skew = (np.abs(gram - np.eye(3)).max(axis=(1, 2)) > ORTHOGONAL) | (handed < 0)
        problems = []
        if skew.any():
            name = self.cameras[int(np.argmax(skew))].name
            allowed = "right-handed axes of length 1, at right angles"
            problems.append(
                Problem(f"camera {name}".strip(), "has a pose that is no rotation", allowed, int(skew.sum()))
            )
        blind = [problem for camera in self.cameras for problem in camera.lens_problems()]
        return problems + [problem._replace(times=len(blind)) for problem in blind[:1]]

    def require_covered(self) -> None:
        """Raises InvalidScene for the first lens that does not cover its picture: asked before any is rendered."""
        for camera in self.cameras:
            for problem in camera.lens_problems():
                raise InvalidScene(problem)

    def require_memory(self, *, pictures: int = 1) -> None:
        """Raises MemoryLimit if so many pictures of every camera do not fit into memory all at once."""
        need = PICTURE_BYTES * pictures * sum(camera.width * camera.height for camera in self.cameras)
        memory.require(f"keeping {pictures * len(self.cameras):,} pictures at once", need)


def require_samples(samples: int) -> int:
    """The number itself, of rays along each edge of a pixel. Raises InvalidScene if it is not 1 to 8."""
    if samples not in range(1, MAX_SAMPLES + 1):
        raise InvalidScene(Problem("samples", f"are {samples!r:.40}", f"1 to {MAX_SAMPLES}"))
    return int(samples)


def rays_told(samples: int) -> str:
    """What is said of pictures with more than one ray a pixel, behind a comma; '' of all others."""
    return "" if samples == 1 else f", {samples}x{samples} rays a pixel"


def _pose_problem(rows: list[list[float]]) -> tuple[str, str] | None:
    """What is wrong with 4 x 4 numbers, and what is allowed; in plain numbers, since captures have many frames."""
    if not all(math.isfinite(value) for row in rows for value in row):
        return "has a pose with NaN or infinity", "4 x 4 finite numbers"
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = rows
    if (most := max(abs(x), abs(y), abs(z))) > MAX_WORLD:
        return f"stands {most:g} away", f"up to {MAX_WORLD:g} world units"
    if (most := max(abs(value) for row in rows[:3] for value in row[:3])) > MAX_AXIS:
        return f"has a pose with an axis of {most:g}", f"a rotation, or axes up to {MAX_AXIS:g}"
    if not abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)) > MIN_VOLUME:
        return "has a singular pose", "an invertible rotation"
    if last != [0, 0, 0, 1]:
        return f"has a pose whose last row is {last}", "0, 0, 0, 1"
    return None


def look_at(
    centre: npt.NDArray[np.float64],
    azimuth: float,
    elevation: float,
    distance: float,
    axes: npt.NDArray[np.float64] = WORLD,
) -> npt.NDArray[np.float64]:
    """(4, 4) pose that looks at a point from so far away; angles in radians, in these axes (rows; the third is up)."""
    (across, along), (up, flat) = sine_cosine(azimuth), sine_cosine(elevation)
    away = np.array([flat * along, flat * across, up])
    return _posed(centre, away, np.array([-across, along, 0.0]), distance, axes)


def look_from(
    centre: npt.NDArray[np.float64],
    away: npt.NDArray[np.float64],
    distance: float,
    axes: npt.NDArray[np.float64] = WORLD,
) -> npt.NDArray[np.float64]:
    """The same from a direction (3,) of length 1 in these axes, which is not the third's own."""
    flat = np.sqrt(away[0] * away[0] + away[1] * away[1])
    return _posed(centre, away, np.array([-away[1] / flat, away[0] / flat, 0.0]), distance, axes)


def _posed(
    centre: npt.NDArray[np.float64],
    away: npt.NDArray[np.float64],
    right: npt.NDArray[np.float64],
    distance: float,
    axes: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = turned(np.stack([right, np.cross(away, right), away]), axes.T).T
    pose[:3, 3] = centre + distance * turned(away, axes.T)
    return pose
