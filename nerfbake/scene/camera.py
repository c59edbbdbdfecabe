"""Cameras and lenses.

Camera axes are those of OpenGL: x right, y up, viewing direction -z. Pixel centres are at half-integer coordinates.
Lens distortion uses the polynomial models that structure from motion fits.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import inverse, length, rotate, transform_points
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.soundness import MAX_EDGE, plural
from nerfbake.scene.base import Scene
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.lens import Lens
from nerfbake.scene.origin import no_origin
from nerfbake.scene.pose import ORTHOGONAL, pose_problem, scale_of
from nerfbake.scene.sparse_points import SparsePoints
from nerfbake.scene.world import UNKNOWN, World


class Raster(NamedTuple):
    """The positions of a picture's pixels on the plane in front of the camera, without the lens."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def points(self, columns: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """(..., 2) centres of these pixels, x right, y down."""
        x, y = (columns + 0.5 - self.cx) / self.fx, (rows + 0.5 - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x, y), axis=-1)


@lru_cache(maxsize=1)  # shared by the frames of a capture: solving for it takes as long as rendering a small picture
def pixel_directions(raster: Raster, lens: Lens) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """The viewing directions of all pixel centres through a lens, (H, W, 3), x right, y down, z forward.

    Also returns (H W,) bool: the pixels for which a direction exists.
    """
    points = raster.points(np.arange(raster.width), np.arange(raster.height)[:, None])
    looks, fine = lens.looks(points.reshape(-1, 2))
    return looks.reshape(*points.shape[:2], 3), fine


@lru_cache(maxsize=64)
def first_blind_pixel(raster: Raster, lens: Lens) -> int | None:
    """The first pixel on the picture's rim that has no viewing direction, or None."""
    x, y = np.arange(raster.width), np.arange(raster.height)
    columns = np.concatenate([x, x, np.zeros_like(y), np.full_like(y, raster.width - 1)])
    rows = np.concatenate([np.zeros_like(x), np.full_like(x, raster.height - 1), y, y])
    _, fine = lens.looks(raster.points(columns, rows))
    return None if fine.all() else int((rows * raster.width + columns)[~fine].min())


FOCAL_LENGTHS = (1e-6, 1e9)  # pixels
WORLD = np.eye(3)
MAX_SAMPLES = 8  # rays along an edge of a pixel
PICTURE_BYTES = 72  # per pixel of a picture that is kept, copied into a contact sheet and encoded (72 measured)


@dataclass(frozen=True, eq=False, repr=False)
class Camera(CompactRepr):
    """A camera. width and height are in pixels; pose (4, 4) float64 maps camera to world; name is the frame's name.

    If the axes of the given pose are a rotation times a number, `pose` is that rotation, because the length of a ray's
    direction has no meaning. The position does not change.

    focal   focal length in pixels: one for both axes, or (fx, fy)
    centre  (cx, cy), the intersection of the optical axis and the picture, in pixels from the upper left corner; None:
            the middle
    lens    distortion in addition to perspective; None: a pinhole
    picture  the photograph: a path in the capture's folder, possibly without extension; '' if unknown
    scale   the number that the axes of the given pose were divided by

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
    scale: float = field(default=1.0, init=False)

    def __post_init__(self) -> None:
        if not (1 <= self.width <= MAX_EDGE and 1 <= self.height <= MAX_EDGE):
            raise self._wrong(f"has {self.width}x{self.height} pixels", f"1 to {MAX_EDGE:,} per edge")
        for focal in (self.fx, self.fy):
            if not FOCAL_LENGTHS[0] <= focal <= FOCAL_LENGTHS[1]:
                raise self._wrong(f"has focal length {focal:g}", f"{FOCAL_LENGTHS[0]:g} to {FOCAL_LENGTHS[1]:g} pixels")
        if not (abs(self.cx) <= FOCAL_LENGTHS[1] and abs(self.cy) <= FOCAL_LENGTHS[1]):
            raise self._wrong(f"has its centre at {self.cx:g}, {self.cy:g}", f"up to {FOCAL_LENGTHS[1]:g} pixels away")
        if self.pose.shape != (4, 4):
            raise self._wrong(f"has a pose of shape {self.pose.shape}", "4 x 4 finite numbers")
        rows = self.pose.tolist()
        if found := pose_problem(rows):
            raise self._wrong(*found)
        if (scale := scale_of(rows)) != 1:
            pose = self.pose.copy()
            pose[:3, :3] /= scale
            object.__setattr__(self, "pose", pose)
            object.__setattr__(self, "scale", scale)

    def _wrong(self, found: str, allowed: str) -> InvalidScene:
        return InvalidScene(Problem(f"camera {self.name}".strip(), found, allowed))

    @property
    def fx(self) -> float:
        """Horizontal focal length in pixels."""
        return self.focal[0] if isinstance(self.focal, tuple) else self.focal

    @property
    def fy(self) -> float:
        """Vertical focal length in pixels."""
        return self.focal[1] if isinstance(self.focal, tuple) else self.focal

    @property
    def cx(self) -> float:
        """Position of the optical axis, in pixels from the left edge."""
        return self.width / 2 if self.centre is None else self.centre[0]

    @property
    def cy(self) -> float:
        """Position of the optical axis, in pixels from the upper edge."""
        return self.height / 2 if self.centre is None else self.centre[1]

    @property
    def bends(self) -> bool:
        """Whether a lens bends the rays."""
        return self.lens is not None and self.lens.bends

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another number of pixels; the horizontal field of view and the pixel's shape stay the
        same.
        """
        focal = self.fx * width / self.width, self.fy * width / self.width
        centre = None
        if self.centre is not None:
            grown = width / self.width
            centre = width / 2 + (self.cx - self.width / 2) * grown, height / 2 + (self.cy - self.height / 2) * grown
        return replace(self, width=width, height=height, focal=focal, centre=centre)

    def reduced(self, factor: int) -> Camera:
        """The camera of the picture in which each pixel is factor x factor pixels; incomplete ones are cut off."""
        if factor == 1:
            return self
        edges = max(self.width // factor, 1), max(self.height // factor, 1)
        focal, centre = (self.fx / factor, self.fy / factor), (self.cx / factor, self.cy / factor)
        return replace(self, width=edges[0], height=edges[1], focal=focal, centre=centre)

    def part(self, columns: slice, rows: slice, *, finer: int = 1) -> Camera:
        """The camera of a crop of the picture, with each pixel divided into finer x finer pixels."""
        width, height = (finer * (pixels.stop - pixels.start) for pixels in (columns, rows))
        centre = finer * (self.cx - columns.start), finer * (self.cy - rows.start)
        return replace(self, width=width, height=height, focal=(finer * self.fx, finer * self.fy), centre=centre)

    def require_memory(self, pixel_bytes: int) -> None:
        """Raise MemoryLimit if `pixel_bytes` bytes per pixel do not fit."""
        memory.require(f"a picture of {self.width}x{self.height} pixels", pixel_bytes * self.width * self.height)

    def rays(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The camera's position (3,) and a unit direction for each pixel (height * width, 3), rows from the top.

        Raises InvalidScene if a pixel has no viewing direction through the lens.
        """
        right, up, back = self.pose[:3, :3].T
        if (slopes := self.slopes()) is not None:
            x, y = slopes
            directions = (x[:, None] * right - back) + (y[:, None] * up)[:, None]
        else:
            looks = self._looks()
            directions = np.empty_like(looks)
            for axis, (r, u, b) in enumerate(zip(right, up, back, strict=True)):
                directions[..., axis] = looks[..., 0] * r - looks[..., 1] * u - looks[..., 2] * b
        across, down, along = np.moveaxis(directions, -1, 0)
        directions /= np.sqrt(across * across + down * down + along * along)[..., None]
        return self.pose[:3, 3], directions.reshape(-1, 3)

    def look(self, x: float, y: float) -> npt.NDArray[np.float64]:
        """The unit direction (3,) in the world of what the picture shows at x, y, in pixels from the upper left corner.

        Raises InvalidScene if nothing is seen there through the lens.
        """
        across, down, ahead = (x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0
        if self.bends:
            assert self.lens is not None
            looks, fine = self.lens.looks(np.array([[across, down]]))
            if not fine[0]:
                raise InvalidScene(self._no_look(int(y) * self.width + int(x), 1))
            across, down, ahead = looks[0].tolist()
        look = rotate(np.array([across, -down, -ahead]), self.pose[:3, :3])
        return look / length(look)

    def slopes(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
        """Where the rays of the columns (W,) and of the rows (H,) cross the plane at distance 1, x right, y up.

        None if a lens bends the rays, so that a column has no common x.
        """
        if self.bends:
            return None
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = -(np.arange(self.height) + 0.5 - self.cy) / self.fy
        return np.asarray(x, np.float64), np.asarray(y, np.float64)

    def plane(self) -> npt.NDArray[np.float64] | None:
        """(H, W, 2) where the rays of the pixels cross the plane at distance 1, x right, y down; None if some do not.

        Raises InvalidScene if a pixel has no viewing direction through the lens.
        """
        if not self.bends:
            return self._seen.points(np.arange(self.width), np.arange(self.height)[:, None])
        looks = self._looks()
        return looks[..., :2] / looks[..., 2:] if (looks[..., 2] > 0).all() else None

    def _looks(self) -> npt.NDArray[np.float64]:
        """(H, W, 3) viewing directions through the lens, x right, y down, z forward."""
        assert self.lens is not None
        looks, fine = pixel_directions(self._seen, self.lens)
        if not fine.all():
            raise InvalidScene(self._no_look(int(np.argmin(fine)), int((~fine).sum())))
        return looks

    def lens_problems(self) -> list[Problem]:
        """The error that rays() would raise, computed from the picture's rim only.

        If all pixels on the rim have a viewing direction, so do all pixels inside it.
        """
        if not self.bends:
            return []
        assert self.lens is not None
        pixel = first_blind_pixel(self._seen, self.lens)
        return [] if pixel is None else [self._no_look(pixel, 1)]

    @property
    def _seen(self) -> Raster:
        return Raster(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def _no_look(self, pixel: int, times: int) -> Problem:
        assert self.lens is not None
        y, x = divmod(pixel, self.width)
        found = f"shows nothing at pixel {x}, {y}: its {self.lens.model} distortion cannot be inverted there"
        return Problem(f"camera {self.name}".strip(), found, "a lens that covers the picture", times)


@dataclass(frozen=True, eq=False, repr=False)
class Cameras(Scene):
    """The cameras of a capture, in order.

    dialect  the program whose conventions the file follows; '' for cameras that were not read from a file
    source   the file or files of a folder that the cameras were read from; '' for a single file
    notes    assumptions made while reading, one line each
    samples  rays along each edge of a pixel, 1 to 8: pictures get samples x samples rays per pixel, as their
             photographs were averaged
    held_out  the numbers of the cameras that the capture holds out: the result is measured on them
    points   the points in space that the program found in the pictures; None: the file has none
    origin   (3,) float64: the point of the world that all positions are relative to, see scene/origin.py; 0 as read
    world    what is known of the unit and of the axes

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
    held_out: tuple[int, ...] = ()
    points: SparsePoints | None = None
    origin: Floats = field(default_factory=no_origin)
    world: World = UNKNOWN

    def __post_init__(self) -> None:
        require_samples(self.samples)
        if not self.cameras:
            raise InvalidScene(Problem("frames", "are an empty list", "at least one camera"))

    def __str__(self) -> str:
        return plural(len(self.cameras), "camera") + (f" ({self.dialect})" if self.dialect else "")

    @property
    def rays_text(self) -> str:
        """Suffix for messages about pictures with more than one ray per pixel, else ''."""
        return rays_text(self.samples)

    def chosen(self, *, size: tuple[int, int] | None = None, samples: int | None = None) -> Cameras:
        """The same cameras with another picture size (W, H) and another number of samples; None: unchanged."""
        cameras = self.cameras if size is None else tuple(camera.resized(*size) for camera in self.cameras)
        return replace(self, cameras=cameras, samples=self.samples if samples is None else samples)

    def few(self, count: int, edge: int) -> Cameras:
        """At most `count` of these cameras, evenly chosen, with pictures of at most `edge` pixels along an edge."""
        step = max(len(self.cameras) / count, 1)
        chosen = []
        for place in range(min(count, len(self.cameras))):
            camera = self.cameras[int(step * (place + 0.5))]
            scale = min(edge / max(camera.width, camera.height), 1)
            chosen.append(camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height))))
        return replace(self, cameras=tuple(chosen))

    def relative_to(self, origin: npt.NDArray[np.float64]) -> Cameras:
        """These cameras in a world whose origin is this point (3,) of theirs."""
        if not origin.any():
            return self
        shift = np.zeros((4, 4))
        shift[:3, 3] = origin
        moved = (replace(camera, pose=camera.pose - shift[: len(camera.pose)]) for camera in self.cameras)
        points = None if self.points is None else replace(self.points, positions=self.points.positions - origin)
        return replace(self, cameras=tuple(moved), points=points, origin=self.origin + origin)

    def take(self, numbers: Sequence[int]) -> Cameras:
        """These cameras alone, in this order. What is held out stays so; points keep what these cameras see."""
        new = {number: i for i, number in enumerate(numbers)}
        points = None if self.points is None else self.points.seen_by(new)
        return replace(
            self,
            cameras=tuple(self.cameras[i] for i in numbers),
            held_out=tuple(new[i] for i in self.held_out if i in new),
            points=points,
        )

    def transformed(self, frame: npt.NDArray[np.float64]) -> Cameras:
        """These cameras in another world. frame (3, 4): to its coordinates; a rotation times a scale, a translation."""
        scale = np.sqrt(np.square(frame[:, 0]).sum())
        moved = []
        for camera in self.cameras:
            pose = np.eye(4)
            pose[:3, :3] = rotate(camera.pose[:3, :3].T, frame[:, :3] / scale).T
            pose[:3, 3] = rotate(camera.pose[:3, 3], frame[:, :3]) + frame[:, 3]
            moved.append(replace(camera, pose=pose))
        points = self.points and replace(self.points, positions=transform_points(self.points.positions, frame))
        return replace(self, cameras=tuple(moved), points=points)

    @property
    def eyes(self) -> npt.NDArray[np.float64]:
        """The positions (n, 3) of the cameras in the world."""
        return np.stack([camera.pose[:3, 3] for camera in self.cameras])

    @property
    def axes(self) -> npt.NDArray[np.float64]:
        """The viewing directions (n, 3) of the cameras in the world."""
        return -np.stack([camera.pose[:3, 2] for camera in self.cameras])

    def looked_at(self, *, towards: npt.NDArray[np.float64], pull: float) -> npt.NDArray[np.float64]:
        """The point (3,) nearest to all optical axes.

        Parallel axes do not intersect. The point is therefore pulled to `towards` (3,), as strongly as `pull` axes do.
        """
        across = np.eye(3) - self.axes[:, :, None] * self.axes[:, None]
        left = across.sum(axis=0) + pull * np.eye(3)
        right = (across * self.eyes[:, None]).sum(axis=(0, 2)) + pull * towards
        return rotate(right, inverse(left))

    @property
    def names(self) -> list[str]:
        return [camera.name for camera in self.cameras]

    def fitting(self, pictures: Iterable[Any]) -> Cameras:
        """The same cameras, each resized to its picture, which has a `size` (W, H)."""
        sized = tuple(view.resized(*picture.size) for view, picture in zip(self.cameras, pictures, strict=True))
        return replace(self, cameras=sized)

    def value_problems(self) -> list[Problem]:
        """Poses that are not rotations, also those with a scale, and lenses that do not cover their picture."""
        scaled = np.array([camera.scale != 1 for camera in self.cameras])
        problems = self._pose_problems(self._skewed() | scaled)
        blind = [problem for camera in self.cameras for problem in camera.lens_problems()]
        return problems + [problem._replace(times=len(blind)) for problem in blind[:1]]

    @property
    def pose_notes(self) -> tuple[str, ...]:
        """What a user should know of the poses, one line each: a scale that is divided out, and axes that are wrong."""
        scales = [camera.scale for camera in self.cameras if camera.scale != 1]
        notes = []
        if scales:
            factors = " to ".join(dict.fromkeys(f"{scale:.4g}" for scale in (min(scales), max(scales))))
            which = f"{len(scales):,} of {plural(len(self.cameras), 'pose')}"
            notes = [f"the axes of {which} are a rotation times {factors}, which is divided out"]
        return *notes, *(f"warning: {problem}" for problem in self._pose_problems(self._skewed()))

    def _skewed(self) -> npt.NDArray[np.bool_]:
        """Return the cameras (n,) with axes that are mirrored, not at right angles, or of different lengths."""
        turns = np.stack([camera.pose[:3, :3] for camera in self.cameras])
        gram = (turns[:, :, :, None] * turns[:, :, None]).sum(axis=1)
        handed = (np.cross(turns[:, 0], turns[:, 1]) * turns[:, 2]).sum(axis=1)
        return np.asarray((np.abs(gram - np.eye(3)).max(axis=(1, 2)) > ORTHOGONAL) | (handed < 0))

    def _pose_problems(self, wrong: npt.NDArray[np.bool_]) -> list[Problem]:
        if not wrong.any():
            return []
        place = f"camera {self.cameras[int(np.argmax(wrong))].name}".strip()
        allowed = "right-handed axes of length 1, at right angles"
        return [Problem(place, "has a pose that is not a rotation", allowed, int(wrong.sum()))]

    def require_covered(self) -> None:
        """Raise InvalidScene for the first lens that does not cover its picture. Call this before rendering."""
        for camera in self.cameras:
            for problem in camera.lens_problems():
                raise InvalidScene(problem)

    def require_memory(self, *, pictures: int = 1) -> None:
        """Raise MemoryLimit if `pictures` pictures of every camera do not fit into memory at once."""
        need = PICTURE_BYTES * pictures * sum(camera.width * camera.height for camera in self.cameras)
        memory.require(f"keeping {pictures * len(self.cameras):,} pictures at once", need)


def require_samples(samples: int) -> int:
    """Return the number of rays along each edge of a pixel. Raises InvalidScene if it is not 1 to 8."""
    if samples not in range(1, MAX_SAMPLES + 1):
        raise InvalidScene(Problem("samples", f"are {samples!r:.40}", f"1 to {MAX_SAMPLES}"))
    return int(samples)


def require_cut(cut: float) -> None:
    """Raise InvalidScene unless rays can end where their transmittance falls below this value."""
    if not 0 <= cut < 1:
        raise InvalidScene(Problem("transmittance_cut", f"is {cut:g}", "0 to 1, excluding 1"))


def rays_text(samples: int) -> str:
    """Suffix for messages about pictures with more than one ray per pixel, starting with a comma, else ''."""
    return "" if samples == 1 else f", {samples}x{samples} rays a pixel"


def look_at(
    centre: npt.NDArray[np.float64],
    azimuth: float,
    elevation: float,
    distance: float,
    axes: npt.NDArray[np.float64] = WORLD,
) -> npt.NDArray[np.float64]:
    """(4, 4) pose at `distance` from a point, looking at it.

    Angles are in radians, in `axes` (rows; the third is up).
    """
    (across, along), (up, flat) = sine_cosine(azimuth), sine_cosine(elevation)
    away = np.array([flat * along, flat * across, up])
    return _posed(centre, away, np.array([-across, along, 0.0]), distance, axes)


def look_from(
    centre: npt.NDArray[np.float64],
    away: npt.NDArray[np.float64],
    distance: float,
    axes: npt.NDArray[np.float64] = WORLD,
) -> npt.NDArray[np.float64]:
    """Like look_at(), for a unit direction (3,) in `axes` instead of angles, not parallel to the third axis."""
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
    pose[:3, :3] = rotate(np.stack([right, np.cross(away, right), away]), axes.T).T
    pose[:3, 3] = centre + distance * rotate(away, axes.T)
    return pose
