"""VDB grids -> sparse voxel octrees: the one they were made from, or one of a fog's density alone."""

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
from nerfbake.stages._fog import density_of


def octree_of_volume(volume: Volume) -> SparseVoxelOctree:
    """The octree behind an index grid, or behind density and sh_0, sh_1, ...: its voxels bit for bit.

    Eight equal neighbours are one leaf, a tile is one as it stands, and voxels of density 0 are no nodes, as
    build_octree has it, so its octrees come back with the same nodes. What inner nodes hold is not in the grids: it is
    made anew by build_octree's rule, with the voxel's width for the finest cell's, and is the same to the bit where
    the octree was baked at its tree's own resolution.

    Raises InvalidScene where the grids hold no octree: other programs' files, and those without coefficients.

    >>> from nerfbake import build_octree, build_vdb, octree_of_volume, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> back = octree_of_volume(build_vdb(octree, grids=("index",)))
    >>> back.size == octree.size, back.level_sizes == octree.level_sizes
    (True, True)
    """
    if volume.frame is None:
        raise InvalidScene(Problem("the volume", "does not say which octree it was", "what `nerfbake vdb` writes"))
    for problem in volume.value_problems():
        raise InvalidScene(problem)
    frame, (topology, data) = volume.frame, _data(volume)
    blocks = blocks_of(topology, data[:, -1] != 0)  # half a float may be 0 where the voxel was thin
    for low, height, _ in blocks:
        if low.min() < 0 or (low.max(axis=0) + (1 << height) > frame.size).any():
            size = "x".join(map(str, frame.size))
            raise InvalidScene(Problem("the volume", f"has voxels outside {size}", "voxels of its octree"))
    return memory.kept(octree_of_blocks(blocks, data, frame))


def octree_of_density(volume: Volume) -> SparseVoxelOctree:
    """An octree of the density of a fog volume, whatever program made it: one value a node, no colour.

    The density is the grid `density`, or the only one with one channel. Voxels and tiles above 0 are leaves, each at
    its own level, in a box of the world's axes around them; a transform may swap and mirror axes. Raises InvalidScene
    for level sets, for transforms that turn or shear, and for boxes of more than 4096 voxels along an axis.

    >>> from nerfbake import build_octree, build_vdb, octree_of_density, sample_n3tree
    >>> smoke = build_vdb(build_octree(sample_n3tree(resolution=8)), grids=("density",))
    >>> octree_of_density(smoke).data_dim
    1
    """
    grid = density_of(volume)
    for problem in (*grid.structure_problems(), *grid.value_problems()):
        raise InvalidScene(problem)
    axis, sign, voxel_size, origin = _axes(volume.transform_of(grid))
    # Of a mirrored axis a cube's other end is its lowest voxel.
    blocks = [
        Block(low[:, axis] * sign - np.where(sign < 0, 1 << height, 0), height, row)
        for low, height, row in blocks_of(grid.topology, grid.values[:, 0] > 0)
    ]
    # What tiles need to be leaves: a box that starts where the largest of them could.
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
    """Of each axis of the world (3,): the grid's axis that runs along it, 1 or -1 for which way, a voxel's edge, and
    where its voxel 0 starts; mirrored axes are counted from -1 down."""
    matrix, centre = transform[:, :3], transform[:, 3]
    along = matrix != 0
    if (along.sum(axis=0) != 1).any() or (along.sum(axis=1) != 1).any():
        allowed = "axes that are the world's, for an octree"
        raise InvalidScene(Problem("the transform", "turns or shears the grid", allowed))
    edges, sign = np.abs(matrix).sum(axis=1), np.sign(matrix.sum(axis=1)).astype(np.int64)
    # Voxel v of a mirrored axis becomes -v - 1: voxel 0 starts where voxel 0 did, half an edge above its centre.
    return along.argmax(axis=1), sign, edges, centre - np.where(sign < 0, -edges / 2, edges / 2)


def _data(volume: Volume) -> tuple[VdbTopology, npt.NDArray[Any]]:
    """The voxels, and (m, D) what they hold, density last."""
    first = volume.grids[0]
    if isinstance(first, IndexGrid):
        return first.topology, first.values
    density = volume.grid("density")
    coefficients = [volume.grid(f"sh_{k}") for k in range(len(volume.grids) - 1) if f"sh_{k}" in _names(volume)]
    if not coefficients:
        allowed = "density,sh or index; `grid=NAME` for an octree of that density alone"
        raise InvalidScene(Problem("the volume", f"has the grids {', '.join(volume.labels)}", allowed))
    for grid in coefficients:
        same = grid.topology.same_as(density.topology)
        if not same or grid.values.shape[1] != 3 or grid.values.dtype != density.values.dtype:
            raise InvalidScene(Problem(f"grid {grid.name!r}", "differs from density in voxels or type", "one topology"))
    # (m, 3, B): all coefficients of red, then of green, then of blue.
    colours = np.stack([grid.values for grid in coefficients], axis=2).reshape(len(density.values), -1)
    return density.topology, np.concatenate([colours, density.values], axis=1)


def _names(volume: Volume) -> list[str]:
    return [grid.name for grid in volume.grids]
