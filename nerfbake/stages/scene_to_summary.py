"""Any scene -> what a person or a script wants to know about it, as plain numbers and text."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.maths.affine import placed
from nerfbake.kernels.maths.extremes import Extremes, extremes
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.camera import Cameras
from nerfbake.scene.depth import Depth
from nerfbake.scene.image import Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume, edges_of
from nerfbake.stages._atlas_summary import summary_of_atlas, summary_of_stage1
from nerfbake.stages._cameras_summary import summary_of_cameras
from nerfbake.stages._lattice_summary import summary_of_lattice
from nerfbake.stages._mesh_summary import summary_of_meshes
from nerfbake.stages._picture_summary import summary_of_picture

Known = N3Tree | LatticeField | SparseVoxelOctree | Volume | Meshes | Cameras | Stage1 | BakedAtlas | Image | Depth


def summarise_scene(scene: Known) -> dict[str, Any]:
    """Kind, basis, resolution, nodes and leaves by level, world box, value ranges, size in memory; JSON can hold it.

    Of a lattice field its colours, its densities and what was left out; of a volume the same by grid, and what its file
    said of its checksum; of a mesh its triangles, pieces and colours; of cameras their pictures and lenses, and where
    they stand; of stage 1 and atlases textures, maps and errors.

    Ranges are over the finite values of leaves that hold something (density above 0): [least, greatest] or None.

    >>> from nerfbake import sample_n3tree, summarise_scene
    >>> facts = summarise_scene(sample_n3tree(resolution=8))
    >>> facts["kind"], facts["basis"], facts["dtype"]
    ('PlenOctree (N3Tree)', 'SH', 'float16')
    """
    if isinstance(scene, Volume):
        return _of_volume(scene)
    if isinstance(scene, LatticeField):
        return summary_of_lattice(scene)
    if isinstance(scene, Meshes):
        return summary_of_meshes(scene)
    if isinstance(scene, Cameras):
        return summary_of_cameras(scene)
    if isinstance(scene, Stage1):
        return summary_of_stage1(scene)
    if isinstance(scene, BakedAtlas):
        return summary_of_atlas(scene)
    if isinstance(scene, Image | Depth):
        return summary_of_picture(scene)
    return _of_n3tree(scene) if isinstance(scene, N3Tree) else _of_octree(scene)


def _of_n3tree(tree: N3Tree) -> dict[str, Any]:
    leaves = tree.leaf_mask.reshape(tree.n, -1)
    data = tree.data.reshape(*leaves.shape, tree.data_dim)
    occupied, cells = leaves & (data[..., -1] > 0), data.reshape(-1, tree.data_dim)
    live = sum(map(len, tree.levels))
    with np.errstate(divide="ignore", invalid="ignore"):
        corners = (np.array([[0.0] * 3, [1.0] * 3]) - tree.offset) / tree.invradius
    # A cell of a node of level d is a cube of level d + 1.
    return {
        "kind": "PlenOctree (N3Tree)",
        "dialect": tree.dialect,
        **_values(tree.data_format, tree.data.dtype),
        "branching": tree.N,
        "forward_facing": tree.ndc,
        "resolution": [tree.resolution] * 3,
        "nodes": live,
        "freed_rows": tree.n - live,
        "nodes_per_level": [len(rows) for rows in tree.levels],
        "leaves": int(leaves.sum()),
        "leaves_per_level": [0] + [int(leaves[rows].sum()) for rows in tree.levels],
        "occupied_leaves": int(occupied.sum()),
        "occupied_per_level": [0] + [int(occupied[rows].sum()) for rows in tree.levels],
        "world_box": _numbers(corners),
        "ranges": _ranges(extremes(cells, occupied.reshape(-1)), tree.data_format),
        "non_finite": extremes(cells, leaves.reshape(-1)).non_finite,
        "held_out": None if tree.held_out is None else str(tree.held_out),
        "bytes_in_memory": tree.child.nbytes + tree.data.nbytes,
    }


def _of_octree(octree: SparseVoxelOctree) -> dict[str, Any]:
    ends = np.cumsum(octree.level_sizes)
    occupied = octree.childless & (octree.sigma > 0)

    def per_level(mask: npt.NDArray[np.bool_]) -> list[int]:
        return [int(part.sum()) for part in np.split(mask, ends[:-1])]

    return {
        "kind": "sparse voxel octree",
        "layout": octree.layout,
        **_values(octree.data_format, octree.node_data.dtype),
        "data_dim": octree.data_dim,
        "resolution": list(octree.size),
        "nodes": octree.n,
        "nodes_per_level": octree.level_sizes,
        "leaves": int(octree.childless.sum()),
        "leaves_per_level": per_level(octree.childless),
        "occupied_leaves": int(occupied.sum()),
        "occupied_per_level": per_level(occupied),
        "world_box": _numbers(octree.origin + np.array([[0.0] * 3, octree.size]) * octree.voxel_size),
        "voxel_size": _numbers(octree.voxel_size),
        "ranges": _ranges(extremes(octree.node_data, occupied), octree.data_format),
        "non_finite": extremes(octree.node_data).non_finite,
        "bytes_in_memory": octree.node_children.nbytes + octree.node_data.nbytes,
    }


def _of_volume(volume: Volume) -> dict[str, Any]:
    return {
        "kind": "VDB volume",
        "checksum": volume.checksum,
        "data_format": volume.frame.data_format or None if volume.frame else None,
        "voxel_size": _numbers(volume.voxel_size),
        "transform": _numbers(volume.transform),
        "grid_names": [grid.name for grid in volume.grids],
        "grids": {
            label: _of_grid(grid, volume.transform_of(grid))
            for label, grid in zip(volume.labels, volume.grids, strict=True)
        },
        "not_read": [f"{problem.place} {problem.found}" for problem in volume.unread] or None,
        "bytes_in_memory": sum(grid.values.nbytes for grid in volume.grids),
    }


def _of_grid(grid: VdbTree | IndexGrid, transform: npt.NDArray[np.float64]) -> dict[str, Any]:
    index = isinstance(grid, IndexGrid)
    active, values, stored = (
        (grid.topology, grid.values, "")
        if isinstance(grid, IndexGrid)
        else (grid.active_topology, grid.active_values, grid.stored)
    )
    box, world = active.box, None
    if box is not None:
        ends = np.stack([box[0] - 0.5, box[1] + 0.5])  # a voxel reaches half its edge around its centre
        corners = np.stack([ends[np.arange(8) >> axis & 1, axis] for axis in range(3)], axis=1)
        corners = placed(corners, transform)
        world = _numbers(np.stack([corners.min(axis=0), corners.max(axis=0)]))
    return {
        "type": "index" if index else "values",
        "class": "index" if isinstance(grid, IndexGrid) else grid.grid_class,
        "dtype": grid.values.dtype.name,
        "stored_as": stored or None,
        "channels": int(grid.values.shape[1]),
        "active_voxels": active.voxel_count,
        "active_tiles": list(active.tile_counts),
        "inactive_values": len(grid.values) - len(values),
        "nodes_per_level": [1, *grid.topology.node_counts],
        "voxel_size": _numbers(edges_of(transform)),
        "index_box": [corner.tolist() for corner in box] if box is not None else None,
        "world_box": world,
        "background": _numbers(grid.background),
        "range": extremes(values).range(),
        "non_finite": extremes(grid.values).non_finite,
    }


def _values(data_format: str, dtype: np.dtype[Any]) -> dict[str, Any]:
    basis = parse_basis(data_format) if data_format else None
    return {
        "data_format": data_format or None,
        "basis": basis.kind if basis else None,
        "basis_size": basis.size if basis else None,
        "dtype": dtype.name,
    }


def _numbers(values: npt.NDArray[Any]) -> Any:
    """Lists of the numbers; None where some are not finite, which JSON cannot say."""
    return values.tolist() if np.isfinite(values).all() else None


def _ranges(found: Extremes, data_format: str) -> dict[str, Any]:
    """Density; the first coefficient of each colour ('dc'); all the higher ones ('higher')."""
    C = len(found.low)
    B = parse_basis(data_format).size if data_format else 1
    columns = np.arange(C - 1)
    return {
        "sigma": found.range(np.array([C - 1])),
        "dc": found.range(columns[columns % B == 0]),
        "higher": found.range(columns[columns % B != 0]),
    }
