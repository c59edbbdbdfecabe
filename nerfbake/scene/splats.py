"""Gaussian splats: ellipsoids with an opacity and spherical harmonics for their colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.march.sh import rotation_of_sh
from nerfbake.kernels.maths.affine import compose, determinant, length, rotate, transform_points
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.soundness import count_problem, plural
from nerfbake.scene.base import MAX_WORLD, Scene, number_problems, require_shape
from nerfbake.scene.origin import no_origin, relative_to, require_origin

BASES = (1, 4, 9, 16, 25)  # coefficients of each colour at degree 0, 1, 2, 3, 4
MOVING = 200  # bytes a splat that transformed() takes beside its result
_UNIT = 1e-3  # how far from 1 the length of a quaternion may be
EVEN = 1e-4  # how far a transform may be from a rotation or reflection times one scale: rounding in files

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
UPS: tuple[Up, ...] = ("x", "-x", "y", "-y", "z", "-z")
# Where x, y and z of a file point, see splat_axes.py; in the order of their numbers in a .spz, from 1.
Axes = Literal[
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"
]  # fmt: skip
# By the axis that points up: the rotation that makes it -y.
_TO_Y_DOWN: dict[Up, list[list[int]]] = {
    "x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "-x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "-y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}


@dataclass(frozen=True, eq=False, repr=False)
class Splats(Scene):
    """Gaussian splats, n rows of each array.

    means        (n, 3) float32, centres in world units
    scales       (n, 3) float32, standard deviations along the splat's own axes, world units, 0 or more
    quats        (n, 4) float32, unit quaternions w, x, y, z: the rotation from the splat's own axes to the world
    opacity      (n,) float32, 0 to 1, at the centre
    sh           (n, B, 3) float32, spherical harmonics in svox's order and signs, red, green, blue last; B is 1, 4, 9,
                 16 or 25. The colour is max(0, SH + 1/2), sRGB, for the direction from the camera to the splat.
    antialiased  the splats were trained with compensation of their opacity for the blur of a pixel
    dropped      rows of the file that were left out because they cannot be drawn
    notes        parts of the file that were ignored, and assumptions, one line each
    up           the axis that points up, if the file says so; None: it does not
    left_out     what of the file was not read, a few words each; notes say what that means
    origin       (3,) float64: the point of the world that the means are relative to; 0 for all files but those far from
                 it, see scene/origin.py. Cameras and boxes of stages are relative to it, too
    axes         the axes in which the file was read, one of scene/splat_axes.py; None: its numbers are the world's
    axes_known   False: the file does not name its axes, and its program is not known to write them as its format says

    The world is that of the training program, usually with y down and z forward: a .ply holds it as it is. Readers of
    formats with other axes turn them.

    >>> import numpy as np
    >>> from nerfbake import Splats
    >>> one = np.ones((1, 3), np.float32)
    >>> turn = np.array([[1, 0, 0, 0]], np.float32)
    >>> print(Splats(one, one, turn, np.ones(1, np.float32), np.zeros((1, 4, 3), np.float32)))
    1 splat of SH degree 1
    """

    means: npt.NDArray[np.float32]
    scales: npt.NDArray[np.float32]
    quats: npt.NDArray[np.float32]
    opacity: npt.NDArray[np.float32]
    sh: npt.NDArray[np.float32]
    antialiased: bool = False
    dropped: int = 0
    notes: tuple[str, ...] = ()
    up: Up | None = None
    left_out: tuple[str, ...] = ()
    origin: Floats = field(default_factory=no_origin)
    axes: Axes | None = None
    axes_known: bool = True

    def __post_init__(self) -> None:
        n = len(self.means)
        B = self.sh.shape[1] if self.sh.ndim == 3 else 0
        if not n:
            raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
        if B not in BASES:
            found = f"has shape {self.sh.shape}"
            raise InvalidScene(Problem("sh", found, f"(n, B, 3), B one of {', '.join(map(str, BASES))}"))
        for name, array, shape in (
            ("means", self.means, (n, 3)),
            ("scales", self.scales, (n, 3)),
            ("quats", self.quats, (n, 4)),
            ("opacity", self.opacity, (n,)),
            ("sh", self.sh, (n, B, 3)),
        ):
            require_shape(name, array, shape, np.float32)
        require_origin(self.origin)

    @property
    def n(self) -> int:
        """Number of splats."""
        return len(self.means)

    @property
    def B(self) -> int:
        """Coefficients of each colour."""
        return int(self.sh.shape[1])

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return BASES.index(self.B)

    def value_problems(self) -> list[Problem]:
        """Values that cannot be drawn."""
        problems = number_problems("means", self.means, most=MAX_WORLD)
        wrong = ~((self.scales >= 0) & (self.scales <= MAX_WORLD))
        problems += count_problem("scales", wrong, self.scales, f"0 to {MAX_WORLD:g}")
        lengths = np.sqrt((self.quats.astype(np.float64) ** 2).sum(axis=1))
        problems += count_problem("quats' lengths", ~(np.abs(lengths - 1) <= _UNIT), lengths, "1")
        outside = ~((self.opacity >= 0) & (self.opacity <= 1))
        problems += count_problem("opacity", outside, self.opacity, "0 to 1")
        return problems + number_problems("sh", self.sh)

    def unread_problems(self) -> list[Problem]:
        """The dropped rows."""
        if not self.dropped:
            return []
        found = f"had {plural(self.dropped, 'row')} that cannot be drawn, which were left out"
        return [Problem("the file", found, "finite numbers, and quaternions other than 0")]

    def flipped(self, signs: tuple[int, int, int] = (1, -1, -1)) -> Splats:
        """Return the splats with the axes of sign -1 in the opposite direction, exact to the bit.

        By default y and z change their signs, half a turn about x. It leads from y down and z forward (.ply) to y up
        and z back, and from there to y down.
        """
        x, y, z = signs
        degrees = [(degree, m) for degree in range(self.degree + 1) for m in range(-degree, degree + 1)]
        # A basis function is odd in y if m < 0, odd in z if degree and m differ by an odd number, and odd at the
        # opposite point if its degree is odd.
        odd = [[(degree - abs(m) + degree + (m < 0)) % 2, int(m < 0), (degree - abs(m)) % 2] for degree, m in degrees]
        flips = np.array([x**a * y**b * z**c for a, b, c in odd], np.float32)
        mirror = np.array(signs, np.float32)
        # An ellipsoid equals its point reflection, so that any signs are those of a rotation.
        turn = np.array([1, *(x * y * z * sign for sign in signs)], np.float32)
        return replace(
            self,
            means=self.means * mirror,
            quats=self.quats * turn,
            sh=self.sh * flips[:, None],
            up=_turned_up(self.up, np.diag(mirror.astype(np.float64))),
            origin=self.origin * mirror + 0.0,
        )

    def transformed(self, matrix: Floats) -> Splats:
        """Return the splats moved by a (3, 4) matrix: a rotation or reflection, times one scale, and a translation.

        Scales and colours move along: the colour for the direction M d is what it was for d. Raises InvalidScene for a
        matrix that shears or scales unevenly, because SH cannot represent the result. The origin moves along, and takes
        the translation; of splats whose origin is 0 the means take it.
        """
        linear = matrix[:3, :3]
        scale = length(linear[:, 0])
        with np.errstate(all="ignore"):
            turn = linear / scale
            off = np.abs(compose(turn.T.copy(), turn) - np.eye(3)).max()
        if not (0 < scale <= MAX_WORLD and off <= EVEN):
            found = "shears, or scales the axes differently"
            raise InvalidScene(Problem("the transform of the splats", found, "a rotation, a reflection, and one scale"))
        proper = turn if determinant(turn) > 0 else -turn  # an ellipsoid equals its point reflection
        far = bool(self.origin.any())
        return replace(
            self,
            means=_float32(rotate(self.means, linear) if far else transform_points(self.means, matrix)),
            scales=_float32(self.scales * scale),
            quats=_float32(_product(_quaternion(proper), self.quats.astype(np.float64))),
            sh=turned_sh(self.sh, rotation_of_sh(turn, self.B)),
            up=_turned_up(self.up, turn),
            origin=transform_points(self.origin, matrix) if far else self.origin,
        )

    def with_up(self, up: Up) -> Splats:
        """Return the splats rotated so that the axis `up` of their world becomes -y, which is up in most .ply files.

        >>> import numpy as np
        >>> from nerfbake import Splats
        >>> turn, half = np.array([[1, 0, 0, 0]], np.float32), np.full(1, 0.5, np.float32)
        >>> place = np.array([[0, 0, 5]], np.float32)
        >>> one = Splats(place, place, turn, half, np.zeros((1, 1, 3), np.float32))
        >>> one.with_up("z").means.tolist()
        [[0.0, -5.0, 0.0]]
        """
        if up == "-y":
            turned = self
        elif up == "y":
            turned = self.flipped()
        else:
            turned = self.transformed(np.column_stack([np.array(_TO_Y_DOWN[up], np.float64), np.zeros(3)]))
        return turned if turned.up == "-y" else replace(turned, up="-y")

    def without_up(self, up: Up) -> Splats:
        """Return the splats that with_up(up) made these of: the axis -y becomes `up` again.

        >>> import numpy as np
        >>> from nerfbake import Splats
        >>> turn, half = np.array([[1, 0, 0, 0]], np.float32), np.full(1, 0.5, np.float32)
        >>> place = np.array([[0, -5, 0]], np.float32)
        >>> one = Splats(place, place + 9, turn, half, np.zeros((1, 1, 3), np.float32))
        >>> one.without_up("z").means.tolist()
        [[0.0, 0.0, 5.0]]
        """
        if up == "-y":
            return self
        if up == "y":
            return self.flipped()
        return self.transformed(np.column_stack([np.array(_TO_Y_DOWN[up], np.float64).T, np.zeros(3)]))

    def take(self, rows: npt.NDArray[Any] | slice) -> Splats:
        """Return the splats of these rows: numbers, a mask, or a slice."""
        arrays = (self.means, self.scales, self.quats, self.opacity, self.sh)
        means, scales, quats, opacity, sh = (array[rows] for array in arrays)
        return replace(self, means=means, scales=scales, quats=quats, opacity=opacity, sh=sh)

    def reach(self, rows: slice = slice(None)) -> Floats:
        """(rows, 3) float64: the standard deviation of each splat along the axes of the world."""
        w, x, y, z = (self.quats[rows, k].astype(np.float64) for k in range(4))
        a, b, c = (self.scales[rows, k].astype(np.float64) for k in range(3))
        lines = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        return np.stack([np.sqrt((r * a) ** 2 + (s * b) ** 2 + (t * c) ** 2) for r, s, t in lines], axis=1)

    def relative_to(self, origin: Floats) -> Splats:
        """Return the same splats with another origin. Far from it, float32 rounds their means."""
        if np.array_equal(origin, self.origin):
            return self
        return replace(self, means=relative_to(self.means, origin - self.origin), origin=origin)

    def with_degree(self, most: int) -> Splats:
        """Return the splats without the bands of SH above this degree."""
        if self.degree <= most:
            return self
        return replace(self, sh=np.ascontiguousarray(self.sh[:, : BASES[most]]))

    def __str__(self) -> str:
        return f"{plural(self.n, 'splat')} of SH degree {self.degree}"


def up_axes(up: Up) -> Floats:
    """Return the axes (3, 3) of a world in which this axis points up: right, forward and up, as rows."""
    if up == "z":
        return np.eye(3)
    return compose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array(_TO_Y_DOWN[up], np.float64))


def _turned_up(up: Up | None, turn: Floats) -> Up | None:
    """The axis that `up` becomes by a rotation; None if it becomes none."""
    if up is None:
        return None
    direction = turn[:, "xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 1 - EVEN:
        return None
    return UPS[2 * axis + int(direction[axis] < 0)]


def _quaternion(matrix: Floats) -> Floats:
    """(4,) the unit quaternion w, x, y, z of a rotation matrix, from the largest of its components."""
    m = matrix
    products = np.array(  # 4 q q^T
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    row = products[int(np.argmax(np.diagonal(products)))]
    return np.asarray(row / length(row))


def _product(first: Floats, second: Floats) -> Floats:
    """The quaternion that rotates by second (n, 4), then by first (4,)."""
    a, b, c, d = first
    w, x, y, z = second.T
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=1,
    )


def turned_sh(sh: npt.NDArray[np.float32], rotation: Floats) -> npt.NDArray[np.float32]:
    """Coefficients (n, B, 3) times a matrix (B, B), each sum in the order of the coefficients."""
    out = np.empty_like(sh)
    for row, shares in enumerate(rotation):
        total = np.zeros((len(sh), 3))
        for column in np.flatnonzero(shares):
            total += shares[column] * sh[:, column]
        out[:, row] = cast(total, np.float32)
    return out


def join_splats(parts: Sequence[Splats]) -> Splats:
    """All splats of the parts, in their order, with the same origin. Coefficients that a part does not have are 0.

    The result is antialiased if the first part is.
    """
    B = max(part.B for part in parts)
    sh = np.zeros((sum(part.n for part in parts), B, 3), np.float32)
    at = 0
    for part in parts:
        sh[at : at + part.n, : part.B] = part.sh
        at += part.n
    means, scales, quats, opacity = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("means", "scales", "quats", "opacity")
    )
    notes, left_out = (
        tuple(dict.fromkeys(line for part in parts for line in getattr(part, name))) for name in ("notes", "left_out")
    )
    dropped, first = sum(part.dropped for part in parts), parts[0]
    own = first.up, left_out, first.origin
    return Splats(means, scales, quats, opacity, sh, first.antialiased, dropped, notes, *own)


class SplatRows(NamedTuple):
    """Rows of a file: any floats, and quaternions of any length."""

    means: npt.NDArray[Any]  # (n, 3)
    scales: npt.NDArray[Any]  # (n, 3)
    quats: npt.NDArray[Any]  # (n, 4) w first
    opacity: npt.NDArray[Any]  # (n,)
    sh: npt.NDArray[Any]  # (n, B, 3)


def splats_of_rows(
    means: npt.NDArray[Any],
    scales: npt.NDArray[Any],
    quats: npt.NDArray[Any],
    opacity: npt.NDArray[Any],
    sh: npt.NDArray[Any],
    *,
    antialiased: bool = False,
    notes: tuple[str, ...] = (),
    origin: Floats | None = None,
) -> Splats:
    """Make splats of a file's rows: any floats, and quaternions of any length. origin: what the means are relative to.

    A row that cannot be drawn is dropped and counted: it has a number that is not finite, a coordinate or scale above
    MAX_WORLD, or a quaternion of length 0. Raises InvalidScene if these are more than half.
    """
    found, dropped = _drawable(SplatRows(means, scales, quats, opacity, sh))
    _require_most(len(means), dropped)
    return Splats(*found, antialiased, dropped, notes, origin=no_origin() if origin is None else origin)


def splats_in_blocks(
    n: int, B: int, rows: Callable[[slice], SplatRows], *, antialiased: bool = False, notes: tuple[str, ...] = ()
) -> Splats:
    """Make splats as splats_of_rows() does of n rows of a file, which rows(slice) decodes.

    They are decoded in blocks, because the numbers of float64 on the way take several times the memory of the splats.
    The splats are counted until the surrounding memory.scope() ends. Raises MemoryLimit.
    """
    memory.hold("the splats", splats_size(n, B))
    with memory.lent("the splats", _WAY * 8 * (11 + 3 * B) * min(n, _BLOCK)):
        shapes = ((n, 3), (n, 3), (n, 4), (n,), (n, B, 3))
        arrays = [np.empty(shape, np.float32) for shape in shapes]
        end = dropped = 0
        for start in range(0, n, _BLOCK):
            found, without = _drawable(rows(slice(start, min(n, start + _BLOCK))))
            for array, part in zip(arrays, found, strict=True):
                array[end : end + len(part)] = part
            end += len(found.means)
            dropped += without
    _require_most(n, dropped)
    means, scales, quats, opacity, sh = (array[:end] for array in arrays)
    return Splats(means, scales, quats, opacity, sh, antialiased, dropped, notes)


_BLOCK = 1 << 13  # rows
_WAY = 5  # copies of a block's numbers in float64 while it is decoded


def splats_size(n: int, B: int) -> int:
    """The bytes of n splats with B coefficients of each colour."""
    return 4 * n * (11 + 3 * B)


def _require_most(n: int, dropped: int) -> None:
    if not n:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    if 2 * dropped > n:
        found = f"have {plural(dropped, 'row')} of {n:,} that cannot be drawn"
        raise InvalidScene(Problem("the splats", found, "at most half: finite numbers, quaternions other than 0"))


def _drawable(rows: SplatRows) -> tuple[SplatRows, int]:
    """Return the rows that can be drawn, as float32 with unit quaternions, and the number of the others."""
    means, scales, quats, opacity, sh = rows
    quats = quats.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt((quats * quats).sum(axis=1))
        good = (np.abs(means) <= MAX_WORLD).all(axis=1) & (scales >= 0).all(axis=1) & (scales <= MAX_WORLD).all(axis=1)
        good &= (lengths > 1e-30) & (lengths < 1e30) & (opacity >= 0) & (opacity <= 1)
        good &= (np.abs(sh) <= np.finfo(np.float32).max).all(axis=(1, 2))
    dropped = len(means) - int(np.count_nonzero(good))
    if dropped:
        means, scales, quats, opacity, sh = (array[good] for array in (means, scales, quats, opacity, sh))
        lengths = lengths[good]
    unit = quats / lengths[:, None]
    return SplatRows(_float32(means), _float32(scales), _float32(unit), _float32(opacity), _float32(sh)), dropped


def _float32(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(cast(values, np.float32))
