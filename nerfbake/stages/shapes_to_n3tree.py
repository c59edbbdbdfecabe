"""A few glossy shapes -> a PlenOctree, as a sample scene for demos, tests and benchmarks that needs no download."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.march.sh import band_of, sh_basis
from nerfbake.kernels.maths.elementary import exp, log, sine_cosine
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.n3tree import N3Tree

SCENE_EDGE = 2.5  # edge of the scene's cube around the origin, in world units
SHELL = 0.05  # depth below a surface with cells as fine as at the surface, in world units
SIGMA = 180.0  # density inside the shapes, 1/world unit
_LIGHT = np.array([0.48, -0.36, 0.8])  # unit, towards the light; z is up
_CHUNK = 1 << 16
_CELL_BYTES = 40  # per cell while its level is computed, in addition to its values (20 to 40 measured)


class Shape(NamedTuple):
    """A shape of the scene. kind: torus, box or ball. size: radius and thickness, half edges, or radius."""

    kind: str
    centre: Floats
    size: Floats
    colour: Floats  # sRGB, 0..1
    gloss: float  # sharpness of the highlight, 0 = matt
    coarseness: int  # number of levels by which its surface is coarser than the finest


def sample_n3tree(*, resolution: int = 128, basis: str = "SH9", seed: int = 0) -> N3Tree:
    """Return a PlenOctree of a glossy torus, balls and a box over a matt floor, lit from above; float16, N = 2.

    resolution: cells along an axis at the finest level, a power of two. Surfaces have the finest cells (the floor one
    level coarser), and the inside of shapes and empty space the coarsest possible ones. The same arguments give the
    same bytes. Raises InvalidScene, MemoryLimit.

    >>> from nerfbake import sample_n3tree
    >>> print(sample_n3tree(resolution=8, basis="SH4"))
    SH4 PlenOctree of 8^3, 54 nodes
    """
    if resolution < 4 or resolution & (resolution - 1):
        raise InvalidScene(Problem("resolution", f"is {resolution}", "a power of two from 4"))
    if parse_basis(basis).kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis!r}", "SH1, SH4, SH9, SH16, SH25"))
    with memory.scope():
        tree = _grown(_shapes(np.random.default_rng(seed)), resolution.bit_length() - 1, basis)
    return memory.kept(tree)


def _grown(shapes: list[Shape], finest: int, data_format: str) -> N3Tree:
    """Build the tree level by level, down to level `finest`."""
    basis = parse_basis(data_format)
    held = 4 + 2 * basis.data_dim  # bytes per cell for its offset and values, which exist per level and in the tree
    steps = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
    nodes = np.zeros((1, 3), np.int64)
    children, values, row = [], [], 0
    for level in range(1, finest + 1):
        memory.hold(f"a tree of {1 << level} cells an axis", 8 * len(nodes) * (2 * held + _CELL_BYTES))
        cells = (2 * nodes[:, None] + steps).reshape(-1, 3)
        width = SCENE_EDGE / (1 << level)
        parts = [cells[start : start + _CHUNK] for start in range(0, len(cells), _CHUNK)]
        divided = np.concatenate([_divides(shapes, _centres(part, width), width, finest - level) for part in parts])
        offset = np.zeros(len(cells), np.int32)
        first = row + len(nodes)
        offset[divided] = first + np.arange(np.count_nonzero(divided)) - (row + np.flatnonzero(divided) // 8)
        children.append(offset.reshape(-1, 2, 2, 2))
        data = np.zeros((len(cells), basis.data_dim), np.float16)
        for part in np.array_split(np.flatnonzero(~divided), 1 + len(cells) // _CHUNK):
            data[part] = _values(shapes, _centres(cells[part], width), width, basis.size)
        values.append(data.reshape(-1, 2, 2, 2, basis.data_dim))
        nodes, row = cells[divided], first
        if not len(nodes):
            break
    return N3Tree(
        child=np.concatenate(children),
        data=np.concatenate(values),
        offset=np.full(3, 0.5),
        invradius=np.full(3, 1 / SCENE_EDGE),
        data_format=data_format,
    )


def _shapes(random: np.random.Generator) -> list[Shape]:
    floor = Shape("box", np.array([0, 0, -0.95]), np.array([1.1, 1.1, 0.06]), np.array([0.55, 0.57, 0.6]), 0.0, 1)
    torus = Shape("torus", np.array([0, 0, -0.25]), np.array([0.62, 0.2]), _colour(random, 0.02), 9.0, 0)
    cube = Shape("box", np.array([0, 0, 0.42]), random.uniform(0.2, 0.3, 3), _colour(random, 0.58), 5.0, 0)
    turn = random.uniform(0, 2 * np.pi)
    balls = []
    for k in range(3):
        angle, radius = turn + k * 2 * np.pi / 3, random.uniform(0.2, 0.28)
        sine, cosine = sine_cosine(angle)
        centre = np.array([0.8 * cosine, 0.8 * sine, radius - 0.89])
        balls.append(Shape("ball", centre, np.array([radius]), _colour(random, 0.15 + 0.25 * k), 14.0, 0))
    return [floor, torus, cube, *balls]


def _colour(random: np.random.Generator, hue: float) -> Floats:
    """Return a saturated colour near a hue (0..1 around the colour wheel)."""
    phase: Floats = 2 * np.pi * (hue + random.uniform(-0.05, 0.05) - np.arange(3) / 3)
    return 0.5 + 0.36 * sine_cosine(phase)[1]


def _centres(cells: npt.NDArray[np.int64], width: float) -> Floats:
    return np.asarray((cells + 0.5) * width - SCENE_EDGE / 2, np.float64)


def _distances(shapes: list[Shape], points: Floats) -> Floats:
    """Return the signed distances (shapes, m) to the surfaces, negative inside."""
    found = []
    for shape in shapes:
        p = points - shape.centre
        if shape.kind == "torus":
            ring = _hypotenuse(p[:, 0], p[:, 1]) - shape.size[0]
            found.append(_hypotenuse(ring, p[:, 2]) - shape.size[1])
        elif shape.kind == "box":
            q = np.abs(p) - shape.size
            found.append(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))
        else:
            found.append(np.linalg.norm(p, axis=1) - shape.size[0])
    return np.stack(found)


def _hypotenuse(a: Floats, b: Floats) -> Floats:
    return np.sqrt(a * a + b * b)


def _divides(shapes: list[Shape], centres: Floats, width: float, levels_left: int) -> npt.NDArray[np.bool_]:
    """Return the cells to divide: they overlap the shell of a shape whose cells are finer at its surface."""
    reach = width * np.sqrt(3) / 2
    divides = np.zeros(len(centres), bool)
    for shape, distance in zip(shapes, _distances(shapes, centres), strict=True):
        if levels_left > shape.coarseness:
            divides |= (distance < reach) & (distance > -SHELL - reach)
    return divides


def _values(shapes: list[Shape], centres: Floats, width: float, B: int) -> npt.NDArray[np.float16]:
    """Return coefficients and density (m, 3 B + 1) of leaves."""
    distances = _distances(shapes, centres)
    nearest, which = distances.min(axis=0), distances.argmin(axis=0)
    out = np.zeros((len(centres), 3 * B + 1))
    # The density rises over half a cell on both sides of the surface.
    sigma = SIGMA * np.clip(0.5 - nearest / width, 0, 1)
    held = sigma > 0
    p, which = centres[held], which[held]
    normal = _normals(shapes, p, which)
    colour = np.stack([shape.colour for shape in shapes])[which]
    stripes = 0.82 + 0.18 * np.sign(sine_cosine(9 * (p + SCENE_EDGE))[0].prod(axis=1, keepdims=True))
    facing = (normal * _LIGHT).sum(axis=1)
    lit = np.clip(colour * stripes * (0.45 + 0.55 * np.maximum(facing, 0))[:, None], 0.02, 0.98)
    # The highlight is visible along d where -d is the mirrored light: a lobe of band weights exp(-l (l + 1) / 2 gloss).
    mirrored = _LIGHT - 2 * facing[:, None] * normal
    gloss = np.array([shape.gloss for shape in shapes])[which]
    bands = band_of(B) * (band_of(B) + 1) / 2
    lobe = sh_basis(mirrored, B) * exp(-bands / np.maximum(gloss, 1e-9)[:, None])
    lobe[:, 0] = 0
    lobe *= (2.2 * (facing > 0) * (gloss > 0))[:, None]
    coefficients = np.repeat(lobe[:, None, :], 3, axis=1)
    # The colour is the sigmoid of the SH sum; Y0 is 1 / sqrt(4 pi).
    coefficients[:, :, 0] += log(lit / (1 - lit)) * np.sqrt(4 * np.pi)
    out[held, :-1] = coefficients.reshape(len(p), 3 * B)
    out[held, -1] = sigma[held]
    return out.astype(np.float16)


def _normals(shapes: list[Shape], points: Floats, which: npt.NDArray[np.int64]) -> Floats:
    """Return the unit gradients (m, 3) of the distance to each point's nearest shape."""
    step, rows = 1e-4, np.arange(len(points))
    gradient = np.empty_like(points)
    for axis in range(3):
        shift = np.eye(3)[axis] * step
        ahead, behind = _distances(shapes, points + shift), _distances(shapes, points - shift)
        gradient[:, axis] = ahead[which, rows] - behind[which, rows]
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return gradient / np.where(length > 0, length, 1)
