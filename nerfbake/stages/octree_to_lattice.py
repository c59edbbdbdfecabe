"""Sparse voxel octree -> lattice field: a node at each voxel's centre, and colours as features of a fitted MLP."""

from __future__ import annotations

from itertools import product as combinations
from math import prod
from typing import NamedTuple, TypedDict

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Coords, Floats, Ints, Points, Singles
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.lattice.mlp import positional_encoding
from nerfbake.kernels.lattice.training import TrainingRows, train
from nerfbake.kernels.maths.elementary import expm1, fibonacci, log, power
from nerfbake.kernels.maths.linear import principal_axes, product
from nerfbake.scene.lattice_field import MAX_EDGE, STEP, Activation, LatticeField, MlpColour
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages._basis_functions import basis_at
from nerfbake.stages.field_to_importance import weigh_leaves
from nerfbake.stages.octree_to_vdb import build_vdb
from nerfbake.stages.scene_to_cameras import scatter_cameras
from nerfbake.stages.scene_to_field import build_field_from_octree

# The sizes that PlenVDB trains, and that its fast renderer requires.
FEATURES, UNITS = 12, 128
FREQUENCIES = (1.0, 2.0, 4.0, 8.0)

# RMS error for the real chair at 256^3: 4.2/255 for a linear code of 12 features along the colours' principal axes,
# without an MLP; 4.6/255 for the MLP after 1,000 rounds, 3.7/255 after 3,000.
ROUNDS = 3000
_ROWS, _DIRECTIONS = 1 << 16, 1 << 13  # numbers of leaves and directions that the MLP is trained on
_SEEN_BY_NOBODY = 1 / 64  # added to the weight of each leaf in the draw; 1 is the weight of a leaf that nothing hides
_COLOURS_AT_ONCE = 1 << 15


class ColourCode(NamedTuple):
    """A linear map to features: (coefficients - mean) @ axes.

    mean  (3 B,)
    axes  (3 B, 12), in descending order of variance
    """

    mean: Floats
    axes: Floats

    def features(self, coefficients: npt.NDArray[np.generic]) -> Singles:
        """Return features (m, 12) of coefficients (m, 3 B)."""
        out = np.empty((len(coefficients), FEATURES), np.float32)
        for begin in range(0, len(out), _COLOURS_AT_ONCE):
            apart = coefficients[begin : begin + _COLOURS_AT_ONCE].astype(np.float64) - self.mean
            out[begin : begin + _COLOURS_AT_ONCE] = product(apart, self.axes)
        return out


def fit_mlp(field: RadianceField, seen: Singles, *, rounds: int, seed: int) -> tuple[ColourCode, MlpColour]:
    """Return a map from a field's coefficients to features, and an MLP fitted to compute the colours from these.

    seen (leaves,): visibility of each leaf, 0 to 1. Leaves are drawn in proportion to it, with directions from the
    whole sphere. The MLP has two hidden layers of 128 units.
    """
    random = np.random.default_rng(seed)
    coefficients = field.values[_drawn(seen, random), :-1]
    code = _code(coefficients.astype(np.float64))
    directions = fibonacci(_DIRECTIONS)
    inputs = positional_encoding(directions, FREQUENCIES).astype(np.float32)
    basis = basis_at(field.basis, directions, np.float32)
    pairs = TrainingRows(code.features(coefficients), coefficients, inputs, basis)
    weights = train(pairs, UNITS, rounds=rounds, seed=seed)
    layers = weights.first, weights.first_bias, weights.middle[None], weights.middle_bias[None]
    return code, MlpColour(*layers, weights.last, weights.last_bias, FREQUENCIES)


def _drawn(seen: Singles, random: np.random.Generator) -> Ints:
    """Draw rows (_ROWS,) at random, in proportion to their visibility."""
    upto = np.cumsum(seen.astype(np.float64) + _SEEN_BY_NOBODY)
    rows: Ints = np.searchsorted(upto, random.random(_ROWS) * upto[-1])
    return np.minimum(rows, len(seen) - 1)


def _code(coefficients: Floats) -> ColourCode:
    """Return the map to features with mean 0 and mean square 1 each.

    If the colours have fewer than 12 principal axes, the other features repeat the first one: PlenVDB requires the
    same number of leaves in each of its colour grids, and a grid of zeros has none.
    """
    count = len(coefficients)
    ones = np.full((1, count), 1 / count)
    mean = product(ones, coefficients)[0]
    apart = coefficients - mean
    axes = np.zeros((len(mean), FEATURES))
    used = min(FEATURES, len(mean))
    axes[:, :used] = principal_axes(apart, used)
    square = product(ones, product(apart, axes) ** 2)[0]
    square[used:] = 0
    axes *= np.where(square > 0, 1 / np.sqrt(np.where(square > 0, square, 1)), 0)
    axes[:, square == 0] = axes[:, :1]
    return ColourCode(mean, axes)


LEAST = 1e-4  # PlenVDB skips a sample if the opacity of its step is below this
_NOTHING = 1e-4  # opacity of a voxel whose raw value is 0; per step, which is half a voxel, it is less than LEAST
# How far the raw value (before the softplus) of a node beside voxels is below its neighbours' mean, and below 0. This
# decides where the surface lies between the two. PSNR of the real chair at 256^3 against its own pictures: 35.3 dB
# with 8 (almost no density), 36.3 with 4, 36.7 with 3, 37.1 with 2, 37.2 with 1 and a rim around it, 36.3 with 0.
_LOWER = 2.0
_WEIGHED = 0.1  # progress when the visibility of the leaves is computed
_FRAMES, _EDGE = 48, 256  # number of cameras for the visibility of the leaves, and pixels along their edges
_ASTRAY = 0.01  # largest shift of the box by the rounding to float32, in voxels
_NODES_AT_ONCE = 1 << 16  # nodes at a time
_NODE_BYTES = 4 * 2 * (FEATURES + 1) + 8 * 6  # per node, while the lattice is built
_AROUND = [step for step in combinations((-1, 0, 1), repeat=3) if any(step)]


class LatticeOptions(TypedDict, total=False):
    """Options of build_lattice() for callers that pass them on."""

    rounds: int
    seed: int


def build_lattice(
    octree: SparseVoxelOctree, *, rounds: int = ROUNDS, seed: int = 0, sigma_min: float | None = None
) -> LatticeField:
    """Convert an octree to a lattice as PlenVDB trains it: values are interpolated first and then activated.

    Each voxel that is dense enough for PlenVDB's renderer becomes a node at its centre, with the voxel's density. Nodes
    next to these have the mean colour of their neighbours, and almost no density. All other nodes are 0, which is an
    opacity of 1e-4 per voxel. The lattice is the box around both kinds of nodes. Its short edges are extended to at
    least two thirds of the longest edge, because PlenVDB computes the number of nodes from the box, and cannot do so
    for other boxes.

    Colours are 12 features for an MLP with two hidden layers of 128 units. The MLP is fitted in `rounds` steps of 2,048
    pairs of a leaf and a direction; leaves that are visible from cameras all around are drawn more often.
    measure_lattice() returns the error of the fit. The same octree, rounds and seed give the same bits on every
    processor.

    sigma_min: treat leaves of less density (1/world unit) as empty. Raises InvalidScene for an octree that is broken,
    has no visible voxels, or has other colours than SH and RGBA, and for voxels that are not cubes; MemoryLimit.

    >>> from nerfbake import build_octree, build_lattice, sample_n3tree
    >>> print(build_lattice(build_octree(sample_n3tree(resolution=8)), rounds=10))
    lattice field of 10x10x8, 556 nodes, MLP of 2x128
    """
    if rounds < 1:
        raise InvalidScene(Problem("rounds", f"are {rounds}", "1 or more"))
    field = build_field_from_octree(octree)
    voxels, values = _voxels(octree, sigma_min)
    low, shape = _extent(voxels)
    box = _box(octree, low, shape)
    with progress.part(0, _WEIGHED):
        seen = weigh_leaves(field, scatter_cameras(field, frames=_FRAMES, edge=_EDGE)).largest
    with progress.part(_WEIGHED, 1):
        code, colour = fit_mlp(field, seen, rounds=rounds, seed=seed)
    links, held = _numbered(voxels - low, shape)
    voxel = _voxel_of(box, shape)
    table = np.zeros((int(links.max()) + 1, FEATURES + 1), np.float32)
    rows = links[tuple((voxels - low).T)]
    table[rows, :-1] = code.features(values[:, :-1] if octree.data_dim > 1 else np.zeros((len(values), 3), np.float32))
    table[rows, -1] = _before_softplus(values[:, -1].astype(np.float64) * voxel)
    _edge(table, links, held)
    shift = float(np.float32(log(1 / (1 - _NOTHING) - 1)))  # files store it as float32
    return memory.kept(
        LatticeField(
            links=links,
            density=np.maximum(table[:, -1] - np.float32(shift), 0),
            features=table[:, :-1].copy(),
            activation=Activation("softplus", shift, 1 / voxel),
            colour=colour,
            box=box,
            at_corners=True,
            occupied=links >= 0,
            least=LEAST,
            dialect="PlenVDB",
        )
    )


def _voxels(octree: SparseVoxelOctree, sigma_min: float | None) -> tuple[Coords, Singles]:
    """Return the voxels (m, 3) that are dense enough to be visible, and their values (m, D)."""
    (grid,) = build_vdb(octree, grids=("index",), sigma_min=sigma_min).grids
    values = grid.values
    held = -expm1(-STEP * float(octree.voxel_size.min()) * values[:, -1].astype(np.float64)) > LEAST
    if not held.any():
        raise InvalidScene(Problem("the octree", "is empty", "a voxel that absorbs 2e-4 of the light or more"))
    memory.require("the octree's voxels", values.nbytes)
    return grid.topology.coords[held], values[held]


def _extent(voxels: Coords) -> tuple[Coords, tuple[int, int, int]]:
    """Return the voxel of the lowest node, and the number of nodes along each axis.

    The nodes extend one beyond the voxels, and further where an edge would be shorter than two thirds of the longest.
    """
    low, high = voxels.min(axis=0) - 1, voxels.max(axis=0) + 1
    edges = high - low + 1
    longest = int(edges.max())
    if longest > MAX_EDGE:
        raise InvalidScene(Problem("the lattice", f"has {longest:,} nodes along an axis", f"{MAX_EDGE:,}"))
    more = np.maximum(-(-2 * longest // 3) - edges, 0)
    x, y, z = (edges + more).tolist()
    return (low - more // 2).astype(np.int32), (x, y, z)


def _box(octree: SparseVoxelOctree, low: Coords, shape: tuple[int, int, int]) -> Points:
    """Return the first and the last node in the world (2, 3), rounded to float32 as PlenVDB stores them."""
    edges = octree.voxel_size
    if not edges.max() <= edges.min() * (1 + 1e-6):
        found = "are {:g} x {:g} x {:g}".format(*edges)
        raise InvalidScene(
            Problem("the octree's voxels", found, "cubes: a lattice has the same node spacing on each axis")
        )
    first = octree.origin + (low + 0.5) * edges
    exact = np.stack([first, first + (np.array(shape) - 1) * edges])
    with np.errstate(over="ignore"):
        box = exact.astype(np.float32).astype(np.float64)
    if not np.abs(box - exact).max() <= _ASTRAY * edges.min():
        found = f"has its voxels of {edges.min():g} at up to {np.abs(exact).max():g}"
        raise InvalidScene(Problem("the octree", found, "a position that float32 resolves to a hundredth of a voxel"))
    return box


def _voxel_of(box: Points, shape: tuple[int, int, int]) -> float:
    """Return the voxel edge that scales raw densities, computed like in PlenVDB: the distance between two nodes."""
    return float(power(float(np.prod(box[1] - box[0])) / prod(edge - 1 for edge in shape), 1 / 3))


def _numbered(voxels: Coords, shape: tuple[int, int, int]) -> tuple[npt.NDArray[np.int32], Bits]:
    """Return links of the nodes of these voxels and their neighbours, x-major, and a mask (X, Y, Z) of the voxels."""
    memory.require("the lattice's links", 10 * prod(shape))
    held = np.zeros(shape, bool)
    held[tuple(voxels.T)] = True
    near = dilated(held)
    links = np.full(shape, -1, np.int32)
    count = int(np.count_nonzero(near))
    memory.require("the lattice's nodes", count * _NODE_BYTES)
    links[near] = np.arange(count, dtype=np.int32)
    return links, held


def _edge(table: Singles, links: npt.NDArray[np.int32], held: Bits) -> None:
    """Write the rows of the nodes next to voxels: the mean of their neighbours, with the density lowered."""
    own = np.pad(np.where(held, links, -1), 1, constant_values=-1)
    beside = np.argwhere((links >= 0) & ~held)
    for begin in range(0, len(beside), _NODES_AT_ONCE):
        some = beside[begin : begin + _NODES_AT_ONCE]
        total, count = np.zeros((len(some), table.shape[1])), np.zeros((len(some), 1))
        for step in _AROUND:
            rows = own[tuple((some + 1 + step).T)]
            there = rows >= 0
            total[there] += table[rows[there]]
            count += there[:, None]
        mean = total / count
        mean[:, -1] = np.minimum(mean[:, -1], 0) - _LOWER
        table[links[tuple(some.T)]] = mean


def _before_softplus(thick: Floats) -> Singles:
    """Return the inverse of the softplus: x such that ln(1 + e^x) = thick."""
    return (thick + log(-expm1(-thick))).astype(np.float32)
