"""VDB grids -> sparse voxel octree: the octree they were made from, or an octree of a fog volume's density."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints
from nerfbake.scene.octree import MAX_SIZE, SparseVoxelOctree
from nerfbake.scene.vdb import IndexGrid
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import OctreeFrame, Volume
from nerfbake.stages._cube_levels import Block, blocks_of, octree_of_blocks


def build_octree_from_volume(volume: Volume) -> SparseVoxelOctree:
    """Rebuild the octree of an index grid, or of density and sh_0, sh_1, ..., with bit-identical voxels.

    Eight equal siblings are merged to one leaf, a tile is one leaf, and voxels of density 0 have no nodes, as in
    build_octree(). So an octree of build_octree() comes back with the same nodes. The grids do not contain the values
    of inner nodes. They are recomputed by the rule of build_octree(), with the voxel width instead of the finest cell's
    width. They are bit-identical if the octree was baked at its tree's own resolution.

    Raises InvalidScene if the grids do not contain an octree: files of other programs, or without coefficients.

    >>> from nerfbake import build_octree, build_vdb, build_octree_from_volume, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> back = build_octree_from_volume(build_vdb(octree, grids=("index",)))
    >>> back.size == octree.size, back.level_sizes == octree.level_sizes
    (True, True)
    """
    if volume.frame is None:
        raise InvalidScene(Problem("the volume", "does not describe an octree", "a volume written by `nerfbake vdb`"))
    for problem in volume.value_problems():
        raise InvalidScene(problem)
    frame, (topology, data) = volume.frame, _data(volume)
    blocks = blocks_of(topology, data[:, -1] != 0)  # float16 may have rounded a low density to 0
    for low, height, _ in blocks:
        if low.min() < 0 or (low.max(axis=0) + (1 << height) > frame.size).any():
            size = "x".join(map(str, frame.size))
            raise InvalidScene(Problem("the volume", f"has voxels outside {size}", "voxels of its octree"))
    return memory.kept(octree_of_blocks(blocks, data, frame))


def build_octree_from_density(volume: Volume) -> SparseVoxelOctree:
    """Build an octree of the density of a fog volume of any program, with one value per node and no colour.

    The density is the grid `density`, or the only one with one channel. Voxels and tiles above 0 become leaves of their
    size, in an axis-aligned box around them. The transform may swap and mirror axes. Raises InvalidScene for level
    sets, for transforms that rotate or shear, and for boxes of more than 4096 voxels along an axis.

    >>> from nerfbake import build_octree, build_vdb, build_octree_from_density, sample_n3tree
    >>> smoke = build_vdb(build_octree(sample_n3tree(resolution=8)), grids=("density",))
    >>> build_octree_from_density(smoke).data_dim
    1
    """
    grid = volume.density()
    for problem in (*grid.structure_problems(), *grid.value_problems()):
        raise InvalidScene(problem)
    axis, sign, voxel_size, origin = _axes(volume.transform_of(grid))
    # Along a mirrored axis, the other end of a cube is its lowest voxel.
    blocks = [
        Block(low[:, axis] * sign - np.where(sign < 0, 1 << height, 0), height, row)
        for low, height, row in blocks_of(grid.topology, grid.values[:, 0] > 0)
    ]
    # Tiles can only be leaves if the box starts at a multiple of the largest tile's edge.
    step = 1 << max((block.height for block in blocks), default=0)
    ends = [(block.low.min(axis=0), block.low.max(axis=0) + (1 << block.height)) for block in blocks]
    low = np.min([low for low, _ in ends] or [np.zeros(3, np.int64)], axis=0) // step * step
    size = np.max([high for _, high in ends] or [np.ones(3, np.int64)], axis=0) - low
    if (size > MAX_SIZE).any():
        found = f"reaches over {'x'.join(f'{int(edge):,}' for edge in size)} voxels"
        raise InvalidScene(Problem(f"grid {grid.name!r}", found, f"{MAX_SIZE:,} along an axis of an octree"))
    frame = OctreeFrame((int(size[0]), int(size[1]), int(size[2])), "", "full", origin + low * voxel_size, voxel_size)
    return memory.kept(
        octree_of_blocks([Block(block.low - low, block.height, block.row) for block in blocks], grid.values, frame)
    )


def _axes(transform: npt.NDArray[np.float64]) -> tuple[Ints, Ints, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return for each axis of the world (3,) the grid's axis along it, its sign, the voxel edge, and the origin.

    The origin is the start of voxel 0. Voxels of mirrored axes are counted down from -1.
    """
    matrix, centre = transform[:, :3], transform[:, 3]
    along = matrix != 0
    if (along.sum(axis=0) != 1).any() or (along.sum(axis=1) != 1).any():
        allowed = "axes parallel to the world's, for an octree"
        raise InvalidScene(Problem("the transform", "rotates or shears the grid", allowed))
    edges, sign = np.abs(matrix).sum(axis=1), np.sign(matrix.sum(axis=1)).astype(np.int64)
    # Voxel v of a mirrored axis becomes -v - 1, so voxel 0 starts half an edge above the centre of the old voxel 0.
    return along.argmax(axis=1), sign, edges, centre - np.where(sign < 0, -edges / 2, edges / 2)


def _data(volume: Volume) -> tuple[VdbTopology, npt.NDArray[Any]]:
    """Return the voxels, and their values (m, D), density last."""
    first = volume.grids[0]
    if isinstance(first, IndexGrid):
        return first.topology, first.values
    density, names = volume.grid("density"), [grid.name for grid in volume.grids]
    coefficients = [volume.grid(f"sh_{k}") for k in range(len(volume.grids) - 1) if f"sh_{k}" in names]
    if not coefficients:
        allowed = "density,sh or index; `grid=NAME` of `nerfbake convert`, for an octree of that density alone"
        raise InvalidScene(Problem("the volume", f"has the grids {', '.join(volume.labels)}", allowed))
    for grid in coefficients:
        same = grid.topology.same_as(density.topology)
        if not same or grid.values.shape[1] != 3 or grid.values.dtype != density.values.dtype:
            raise InvalidScene(Problem(f"grid {grid.name!r}", "differs from density in voxels or type", "one topology"))
    # (m, 3, B): all coefficients of red, then of green, then of blue.
    colours = np.stack([grid.values for grid in coefficients], axis=2).reshape(len(density.values), -1)
    return density.topology, np.concatenate([colours, density.values], axis=1)
