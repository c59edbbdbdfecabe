"""Sparse voxel octree -> lattice field: a node at each voxel's centre, features, and an MLP that makes them colours."""

from __future__ import annotations

from itertools import product as combinations
from math import prod

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Coords, Floats, Points, Singles
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.maths.elementary import expm1, log, power
from nerfbake.scene.lattice_field import MAX_EDGE, STEP, Activation, LatticeField
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.stages._mlp_of_colours import FEATURES, ROUNDS, fit_mlp
from nerfbake.stages.field_to_importance import weigh_leaves
from nerfbake.stages.octree_to_field import field_of_octree
from nerfbake.stages.octree_to_vdb import build_vdb
from nerfbake.stages.scene_to_cameras import sphere_cameras

LEAST = 1e-4  # the opacity of a step below which PlenVDB skips a sample
_NOTHING = 1e-4  # that of a voxel whose raw value is 0: less than LEAST in a step, which is half a voxel
# How much lower nodes beside voxels are before the softplus than their neighbours, and than 0: where the surface stands
# between the two. Pictures of the real chair at 256^3 are 35.3 dB from its own with 8 (which is nearly nothing), 36.3
# with 4, 36.7 with 3, 37.1 with 2, 37.2 with 1 and a rim around it, 36.3 with 0.
_LOWER = 2.0
_WEIGHED = 0.1  # of the work is done when it is known which leaves are seen
_FRAMES, _EDGE = 48, 256  # of the cameras that tell which leaves there are to be seen
_ASTRAY = 0.01  # of a voxel: how far float32 may move the box
_CHUNK = 1 << 16  # nodes at a time
_NODE_BYTES = 4 * 2 * (FEATURES + 1) + 8 * 6  # while the lattice is made
_AROUND = [step for step in combinations((-1, 0, 1), repeat=3) if any(step)]


def lattice_of_octree(
    octree: SparseVoxelOctree, *, rounds: int = ROUNDS, seed: int = 0, sigma_min: float | None = None
) -> LatticeField:
    """The octree as PlenVDB trains a field: values between nodes are interpolated, and only then activated.

    A node stands at the centre of each voxel that is thick enough to be seen by its renderer, and has the voxel's
    density there. Around those, nodes one further have colours that are the means of their neighbours', and hardly any
    density; all others are 0, which stands for an opacity of 1e-4 in a voxel. The lattice is the box around the first
    two, its short edges made two thirds of its longest at least: of a box PlenVDB works out how many nodes it has, and
    of others it could not.

    Colours are 12 features for an MLP of two hidden layers of 128 units, fitted in so many `rounds` of 2,048 leaves and
    directions each; the leaves that cameras all around see are shown the more often. measure_lattice() tells what that
    costs. The same octree, rounds and seed give the same bits on every processor.

    sigma_min: treat leaves of less density (1/world unit) as empty. Raises InvalidScene for a broken octree, one that
    holds nothing or has other colours than SH and RGBA, and for voxels that are no cubes; MemoryLimit.

    >>> from nerfbake import build_octree, lattice_of_octree, sample_n3tree
    >>> print(lattice_of_octree(build_octree(sample_n3tree(resolution=8)), rounds=10))
    lattice field of 10x10x8, 556 nodes, MLP of 2x128
    """
    if rounds < 1:
        raise InvalidScene(Problem("rounds", f"are {rounds}", "1 or more"))
    field = field_of_octree(octree)
    voxels, values = _voxels(octree, sigma_min)
    low, shape = _extent(voxels)
    box = _box(octree, low, shape)
    with progress.part(0, _WEIGHED):
        seen = weigh_leaves(field, sphere_cameras(field, frames=_FRAMES, edge=_EDGE)).largest
    with progress.part(_WEIGHED, 1):
        code, colour = fit_mlp(field, seen, rounds=rounds, seed=seed)
    links, held = _numbered(voxels - low, shape)
    voxel = _voxel_of(box, shape)
    table = np.zeros((int(links.max()) + 1, FEATURES + 1), np.float32)
    rows = links[tuple((voxels - low).T)]
    table[rows, :-1] = code.features(values[:, :-1] if octree.data_dim > 1 else np.zeros((len(values), 3), np.float32))
    table[rows, -1] = _before_softplus(values[:, -1].astype(np.float64) * voxel)
    _edge(table, links, held)
    shift = float(np.float32(log(1 / (1 - _NOTHING) - 1)))  # as files have it
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
    """(m, 3) the voxels that are seen, and their values (m, D)."""
    (grid,) = build_vdb(octree, grids=("index",), sigma_min=sigma_min).grids
    values = grid.values
    held = -expm1(-STEP * float(octree.voxel_size.min()) * values[:, -1].astype(np.float64)) > LEAST
    if not held.any():
        raise InvalidScene(Problem("the octree", "holds nothing", "a voxel that takes 2e-4 of the light or more"))
    memory.require("the octree's voxels", values.nbytes)
    return grid.topology.coords[held], values[held]


def _extent(voxels: Coords) -> tuple[Coords, tuple[int, int, int]]:
    """The lowest node's voxel, and how many nodes there are along each axis: one around the voxels, and more where an
    edge would be shorter than two thirds of the longest."""
    low, high = voxels.min(axis=0) - 1, voxels.max(axis=0) + 1
    edges = high - low + 1
    longest = int(edges.max())
    if longest > MAX_EDGE:
        raise InvalidScene(Problem("the lattice", f"has {longest:,} nodes along an axis", f"{MAX_EDGE:,}"))
    more = np.maximum(-(-2 * longest // 3) - edges, 0)
    x, y, z = (edges + more).tolist()
    return (low - more // 2).astype(np.int32), (x, y, z)


def _box(octree: SparseVoxelOctree, low: Coords, shape: tuple[int, int, int]) -> Points:
    """(2, 3) the first and the last node in the world, as float32 has them, which is what PlenVDB keeps."""
    edges = octree.voxel_size
    if not edges.max() <= edges.min() * (1 + 1e-6):
        found = "are {:g} x {:g} x {:g}".format(*edges)
        raise InvalidScene(
            Problem("the octree's voxels", found, "cubes: a lattice's nodes are as far apart on each axis")
        )
    first = octree.origin + (low + 0.5) * edges
    exact = np.stack([first, first + (np.array(shape) - 1) * edges])
    with np.errstate(over="ignore"):
        box = exact.astype(np.float32).astype(np.float64)
    if not np.abs(box - exact).max() <= _ASTRAY * edges.min():
        found = f"has its voxels of {edges.min():g} at up to {np.abs(exact).max():g}"
        raise InvalidScene(Problem("the octree", found, "a place that float32 tells to a hundredth of a voxel"))
    return box


def _voxel_of(box: Points, shape: tuple[int, int, int]) -> float:
    """The edge of the voxel that raw densities are reckoned with, as PlenVDB works it out: a node's distance."""
    return float(power(float(np.prod(box[1] - box[0])) / prod(edge - 1 for edge in shape), 1 / 3))


def _numbered(voxels: Coords, shape: tuple[int, int, int]) -> tuple[npt.NDArray[np.int32], Bits]:
    """Links of the nodes of these voxels and of all around them, x-major; and (X, Y, Z) which of them are voxels."""
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
    """Writes the rows of the nodes beside what is held: their neighbours' mean, whose density is made lower."""
    own = np.pad(np.where(held, links, -1), 1, constant_values=-1)
    beside = np.argwhere((links >= 0) & ~held)
    for begin in range(0, len(beside), _CHUNK):
        some = beside[begin : begin + _CHUNK]
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
    """x such that ln(1 + e^x) is this."""
    return (thick + log(-expm1(-thick))).astype(np.float32)
