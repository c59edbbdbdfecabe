"""Sparse voxel octree -> VDB grids: density, colour, SH coefficients, or all of it behind one index."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, MemoryLimit, Problem
from nerfbake.kernels.sh import sh_basis
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import IndexGrid, VdbTopology, VdbTree, topology_of
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages._half import rounded

GRIDS = ("density", "Cd", "sh", "index")
MAX_MEMORY = 4 << 30
_WORK_BYTES = 96  # a voxel's coordinates, sort key, order and row while the tree is built
Ints = npt.NDArray[np.int64]


def build_vdb(
    octree: SparseVoxelOctree,
    *,
    grids: tuple[str, ...] = ("density", "Cd"),
    half: bool = False,
    sigma_min: float | None = None,
    up: Up = "z",
    max_memory: int = MAX_MEMORY,
) -> Volume:
    """The octree's voxels as grids over one topology.

    grids, any of these, `index` alone:
      density  float, 1/world unit
      Cd       colour, sRGB 0..1: the sigmoid of the SH's mean over all directions. Every basis function but the
               first averages to 0 over the sphere, so that mean is the first coefficient times 1 / (2 sqrt(pi)).
               (It is not the mean of the sigmoid, which no closed form gives; they agree where colour does not
               depend on the view.) RGBA has its colours as they are, behind the same sigmoid.
      sh       sh_0, sh_1, ...: the coefficients of red, green and blue of each basis function
      index    an IndexGrid with a table of all D values, density last

    Leaves above density 0 (and from sigma_min, 1/world unit) become voxels, large ones many; the rest is background,
    0. half: values are float16. up: the world's axis that the field's z becomes; `y` turns (x, y, z) into
    (x, z, -y) in the transform alone, voxels and SH stay as they are. max_memory bounds voxels and their making,
    in bytes, before any is made. Raises InvalidScene, MemoryLimit.
    """
    _require_usable(octree, grids, up)
    if sigma_min is not None and not sigma_min >= 0:
        raise InvalidScene(Problem("sigma_min", f"is {sigma_min:g}", "0 or more"))
    occupied = octree.childless & (octree.sigma > 0) & (octree.sigma >= (sigma_min or 0.0))
    width = octree.data_dim * octree.node_data.itemsize + _WORK_BYTES
    coords, node = _voxels(octree, occupied, lambda count: _require_room(count * width, max_memory))
    topology, order = topology_of(coords)
    frame = OctreeFrame(
        octree.size, octree.data_format, octree.layout, octree.origin, octree.voxel_size, octree.extra_data
    )
    dtype = np.dtype(np.float16 if half else np.float32)
    made = _grids(octree, grids, topology, node[order], dtype)
    return Volume(tuple(made), _transform(octree, up), frame)


def _grids(
    octree: SparseVoxelOctree, grids: tuple[str, ...], topology: VdbTopology, node: Ints, dtype: np.dtype[Any]
) -> Iterator[VdbTree | IndexGrid]:
    data, B = octree.node_data, (octree.data_dim - 1) // 3

    def tree(name: str, values: npt.NDArray[Any]) -> VdbTree:
        return VdbTree(name, topology, _rounded(name, values, dtype), np.zeros(values.shape[1], np.float32))

    for grid in grids:
        if grid == "index":
            table = np.zeros((len(node) + 1, octree.data_dim), dtype)
            table[1:] = _rounded(grid, data[node], dtype)
            yield IndexGrid("index", topology, table)
        elif grid == "density":
            yield tree("density", data[node, -1:])
        elif grid == "Cd":
            yield tree("Cd", _colour(octree, node))
        else:
            for k in range(B):
                yield tree(f"sh_{k}", data[node[:, None], [k, B + k, 2 * B + k]])


def _colour(octree: SparseVoxelOctree, node: Ints) -> npt.NDArray[np.float32]:
    """(m, 3) sRGB: what a voxel shows on average."""
    basis = parse_basis(octree.data_format)
    first = octree.node_data[node[:, None], [0, basis.size, 2 * basis.size]].astype(np.float64)
    scale = 1.0 if basis.kind == "RGBA" else float(sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)[0, 0])
    # tanh is the sigmoid that never overflows: 1 / (1 + exp(-x)) = (1 + tanh(x / 2)) / 2.
    return (0.5 + 0.5 * np.tanh(0.5 * scale * first)).astype(np.float32)


def _rounded(name: str, values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    return rounded(values, dtype, what=f"grid {name!r}", asked="--half")


# -- voxels ----------------------------------------------------------------------------------------------------
def _voxels(octree: SparseVoxelOctree, which: npt.NDArray[np.bool_], require_room: Any) -> tuple[Ints, Ints]:
    """(m, 3) the voxels that these leaves fill, inside the grid, and (m,) the node of each."""
    size, levels, total = np.array(octree.size), [], 0
    for start, corner, edge in _levels(octree):
        own = np.flatnonzero(which[start : start + len(corner)])
        corner = corner[own]
        extent = np.clip(size - corner, 0, edge)
        total += int(extent.prod(axis=1).sum())
        levels.append((start + own, corner, edge, bool((extent < edge).any())))
    require_room(total)
    coords, nodes = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for node, corner, edge, cut in levels:
        if not len(node):
            continue
        reach = np.minimum(edge, (size - corner).max(axis=0)) if cut else np.full(3, edge)
        steps = np.stack(np.meshgrid(*map(np.arange, reach), indexing="ij"), axis=-1).reshape(-1, 3)
        voxel = (corner[:, None] + steps).reshape(-1, 3)
        node = np.repeat(node, len(steps))
        if cut:
            inside = (voxel < size).all(axis=1)
            voxel, node = voxel[inside], node[inside]
        coords.append(voxel)
        nodes.append(node)
    return np.concatenate(coords), np.concatenate(nodes)


def _levels(octree: SparseVoxelOctree) -> Iterator[tuple[int, Ints, int]]:
    """Of each level its first node, (n, 3) the lowest voxels of its nodes, and their edge in voxels."""
    slots = np.flatnonzero(octree.node_children.reshape(-1))  # of nodes 1, 2, 3, ...
    corner, start, edge = np.zeros((1, 3), np.int64), 0, 1 << octree.grid_level
    for nodes in octree.level_sizes:
        if start:
            own = slots[start - 1 : start - 1 + nodes]
            edge //= 2
            corner = corner[own // 8 - (start - len(corner))] + (own[:, None] >> np.arange(3) & 1) * edge
        yield start, corner, edge
        start += nodes


def _transform(octree: SparseVoxelOctree, up: Up) -> npt.NDArray[np.float64]:
    """(3, 4) from a voxel's index to its centre in the world."""
    transform = np.column_stack([np.diag(octree.voxel_size), octree.origin + octree.voxel_size / 2])
    if up == "z":
        return transform
    return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ transform


# -- what may be asked -----------------------------------------------------------------------------------------
def _require_usable(octree: SparseVoxelOctree, grids: tuple[str, ...], up: str) -> None:
    octree.require_sound()
    for problem in octree.value_problems():
        raise InvalidScene(problem)
    known = set(grids) <= set(GRIDS) and len(set(grids)) == len(grids) > 0
    if not known or ("index" in grids and len(grids) > 1):
        raise InvalidScene(Problem("grids", f"are {','.join(grids)!r}", "some of density, Cd, sh, or index alone"))
    if up not in ("y", "z"):
        raise InvalidScene(Problem("up", f"is {up!r}", "y, z"))
    if "Cd" in grids and (not octree.data_format or parse_basis(octree.data_format).kind not in ("SH", "RGBA")):
        raise InvalidScene(Problem("grid 'Cd'", f"of data_format {octree.data_format!r}", "SH and RGBA"))
    if "sh" in grids and octree.data_dim % 3 != 1:
        raise InvalidScene(Problem("grid 'sh'", f"of {octree.data_dim} values a node", "3 B + 1 values"))


def _require_room(need: int, max_memory: int) -> None:
    if need > max_memory:
        raise MemoryLimit("the octree as voxels", need, max_memory)
