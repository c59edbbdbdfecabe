"""Any scene -> a summary of its facts as plain numbers and text, for people and scripts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import UsageError
from nerfbake.kernels.cluster.colours import codes_of
from nerfbake.kernels.maths.affine import transform_points
from nerfbake.kernels.maths.elementary import Extremes, extremes
from nerfbake.kernels.surface.edges import mesh_edges
from nerfbake.kernels.surface.normals import welded
from nerfbake.scene.atlas import BakedAtlas, OctahedralAtlas
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.environment import EnvironmentMap
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import Depth, Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Mesh, Meshes, joined_meshes, vertex_box
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import SpecularField, Stage1
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume, edges_of
from nerfbake.stages._function_summary import summary_of_function


def summary_of_stage1(stage1: Stage1) -> dict[str, Any]:
    """Return each cascade's textures, MLP and mesh, and the number of cameras."""
    parts = zip(stage1.fields, stage1.meshes, strict=True)
    return {
        "kind": "MobileNeRF" if stage1.deferred else "nerf2mesh stage 1",
        "cameras": None if stage1.cameras is None else len(stage1.cameras),
        "cascades": {str(c): {**_of_field(field), **_of_mesh(mesh)} for c, (field, mesh) in enumerate(parts)},
    }


def summary_of_atlas(baked: BakedAtlas) -> dict[str, Any]:
    """Return each cascade's maps, labels and mesh, with the errors and options in its atlas.json."""
    errors = baked.facts.get("errors")
    parts = zip(baked.atlases, baked.meshes, strict=True)
    return {
        "kind": "octahedral atlas",
        "bake": _plain_facts(baked.facts.get("bake")),
        "cascades": {
            str(c): {
                **_of_atlas(atlas),
                **_of_mesh(mesh),
                "errors": _plain_facts(errors[c] if isinstance(errors, list) and c < len(errors) else None),
            }
            for c, (atlas, mesh) in enumerate(parts)
        },
    }


def _of_field(field: SpecularField) -> dict[str, Any]:
    H, W, _ = field.features.shape
    return {
        "texture": [W, H],
        "texels_used": int(np.count_nonzero(field.used)),
        "colours": len(np.unique(codes_of(field.features[field.used]))),
        "hidden_units": int(field.w0.shape[1]),
    }


def _of_atlas(atlas: OctahedralAtlas) -> dict[str, Any]:
    H, W = atlas.labels.shape
    return {
        "method": atlas.method,
        "clusters": atlas.K,
        "maps": len(atlas.tiles),
        "map_size": atlas.R,
        "border": atlas.border,
        "texture": [W, H],
        "labels_used": len(np.unique(atlas.labels)),
    }


def _of_mesh(mesh: Mesh | None) -> dict[str, Any]:
    diffuse = None if mesh is None or mesh.texture is None else list(mesh.texture.shape[1::-1])
    return {"triangles": None if mesh is None else len(mesh.faces), "diffuse": diffuse}


def _plain_facts(facts: Any) -> dict[str, Any] | None:
    """Return the numbers and short texts of an object from a file, which may contain anything."""
    if not isinstance(facts, Mapping):
        return None
    return {
        key: value
        for key, value in facts.items()
        if len(key) <= 40 and (isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= 40))
    }


_AGREE = 0.5  # smallest length of the mean of all cameras' up vectors; 1 if all agree
ALONG = 0.95  # smallest share of an axis in this mean, for the axis to be reported as up


def summary_of_cameras(cameras: Cameras) -> dict[str, Any]:
    """Return the dialect, pictures by size, focal lengths and centres in pixels, lenses, and camera positions.

    Ranges are [minimum, maximum] over all cameras. Centres are relative to the middle of the picture. up is an axis of
    the world if the cameras' up vectors agree on it, as in a hand-held capture, else None. samples is included if
    pictures have more than one ray per pixel.
    """
    all_of = cameras.cameras
    places = np.array([camera.pose[:3, 3] for camera in all_of])
    return {
        "kind": "cameras",
        "dialect": cameras.dialect or None,
        "read_from": cameras.source or None,
        "cameras": len(all_of),
        "pictures": dict(Counter(f"{camera.width}x{camera.height}" for camera in all_of)),
        "focal_x": _range([camera.fx for camera in all_of]),
        "focal_y": _range([camera.fy for camera in all_of]),
        "centre_x_off": _range([camera.cx - camera.width / 2 for camera in all_of]),
        "centre_y_off": _range([camera.cy - camera.height / 2 for camera in all_of]),
        **({} if cameras.samples == 1 else {"samples": cameras.samples}),
        "lenses": dict(Counter(map(_lens, all_of))),
        **({} if cameras.points is None else {"points": len(cameras.points)}),
        **({} if not cameras.held_out else {"held_out": len(cameras.held_out)}),
        "position_box": [places.min(axis=0).tolist(), places.max(axis=0).tolist()],
        "up": _up(np.array([camera.pose[:3, 1] for camera in all_of])),
        "notes": [*cameras.notes, *cameras.pose_notes] or None,
    }


def _range(values: list[float]) -> list[float]:
    return [float(min(values)), float(max(values))]


def _lens(camera: Camera) -> str:
    if not camera.bends:
        return "pinhole"
    assert camera.lens is not None
    k = ", ".join(f"k{i} {value:g}" for i, value in enumerate(camera.lens.k, start=1) if value)
    p = ", ".join(f"p{i} {value:g}" for i, value in enumerate(camera.lens.p, start=1) if value)
    s = ", ".join(f"s{i} {value:g}" for i, value in enumerate(camera.lens.prism, start=1) if value)
    skew = f"skew {camera.lens.skew:g}" if camera.lens.skew else ""
    parts = ", ".join(part for part in (k, p, s, skew) if part)
    return f"{camera.lens.model} ({parts})" if parts else camera.lens.model


def _up(ups: npt.NDArray[np.float64]) -> str | None:
    mean = (ups / np.linalg.norm(ups, axis=1, keepdims=True)).mean(axis=0)
    length, axis = np.sqrt((mean * mean).sum()), int(np.argmax(np.abs(mean)))
    if length < _AGREE or abs(mean[axis]) < ALONG * length:
        return None
    return f"{'-' if mean[axis] < 0 else ''}{'xyz'[axis]}"


def summary_of_lattice(lattice: LatticeField) -> dict[str, Any]:
    """Return the dialect, sizes, activation, colours, world box and value ranges, as JSON types."""
    density, features = extremes(lattice.density[:, None]), extremes(lattice.features)
    kind, shift, scale = lattice.activation
    mask = lattice.occupied
    held = lattice.links >= 0
    blocks: dict[str, Any] = {}
    if lattice.blocks is not None:
        blocks = {"blocks": list(held.shape), "held_blocks": int(np.count_nonzero(held))}
        blocks["planes"] = None if lattice.planes is None else lattice.planes.density.shape[1]
    return {
        "kind": "lattice field",
        "dialect": lattice.dialect,
        "resolution": list(lattice.shape),
        "nodes": lattice.n,
        "linked_nodes": int(np.count_nonzero(held)) if lattice.blocks is None else lattice.n,
        **blocks,
        "mask": None if mask is None else list(mask.shape),
        "masked_nodes": None if mask is None else int(np.count_nonzero(mask)),
        "colours": str(lattice.colour),
        "dtype": lattice.features.dtype.name,
        "activation": {"kind": kind, "shift": float(shift), "scale": float(scale)},
        "nodes_at_corners": lattice.at_corners,
        "world_box": lattice.box.tolist() if np.isfinite(lattice.box).all() else None,
        "step": lattice.step if np.isfinite(lattice.step) else None,
        "ranges": {"density": density.range(), "features": features.range()},
        "non_finite": density.non_finite + features.non_finite,
        "notes": list(lattice.notes) or None,
        "bytes_in_memory": lattice.links.nbytes + lattice.density.nbytes + lattice.features.nbytes,
    }


# Bytes while edges are paired, as measured. A triangle has three edges, and each is in several tables.
_PER_TRIANGLE, _PER_VERTEX = 300, 60


def summary_of_meshes(scene: Meshes) -> dict[str, Any]:
    """Return triangles, box, colours, and facts about the surface of all meshes together.

    pieces          number of connected components
    closed          True if every edge has two triangles: a surface without holes and borders
    same_winding    True if all triangles with a common edge face the same side

    Vertices at the same position count as one, because texture coordinates split them. Degenerate triangles are
    ignored. All three facts are None if the memory limit is too small to compute them.
    """
    arrays = [(m.positions, m.faces, m.uvs, m.texture, m.colours) for m in scene.meshes]
    box = vertex_box(scene.meshes) + scene.origin
    return {
        "kind": "triangle mesh",
        "meshes": len(scene.meshes),
        "triangles": sum(len(mesh.faces) for mesh in scene.meshes),
        "vertices": sum(len(mesh.positions) for mesh in scene.meshes),
        **_surface(scene),
        "origin": scene.origin.tolist(),
        "world_box": box.tolist(),
        "textures": [None if mesh.texture is None else list(mesh.texture.shape[1::-1]) for mesh in scene.meshes],
        "vertex_colours": [mesh.colours is not None for mesh in scene.meshes],
        "notes": list(scene.notes) or None,
        "bytes_in_memory": sum(array.nbytes for parts in arrays for array in parts if array is not None),
    }


def _surface(scene: Meshes) -> dict[str, Any]:
    need = sum(_PER_TRIANGLE * len(mesh.faces) + _PER_VERTEX * len(mesh.positions) for mesh in scene.meshes)
    if need > memory.left():
        return {"pieces": None, "closed": None, "same_winding": None}
    positions, corners, _ = joined_meshes(scene.meshes)
    faces = welded(positions)[1][corners]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if not len(faces):
        return {"pieces": 0, "closed": False, "same_winding": True}
    edges = mesh_edges(faces, len(positions))
    pieces = edges.count_pieces(len(positions))
    return {"pieces": pieces, "closed": edges.closed, "same_winding": edges.same_winding}


def summary_of_light(environment: EnvironmentMap) -> dict[str, Any]:
    """Return the size in pixels, and the range of the linear radiance."""
    H, W, _ = environment.radiance.shape
    ends = (environment.radiance.min(), environment.radiance.max())
    return {"kind": "environment map", "size": [W, H], "range": [float(end) for end in ends]}


def summary_of_picture(picture: Image | Depth) -> dict[str, Any]:
    """Return the size in pixels; for a picture its opaque share, for depth the share of hits and their range."""
    if isinstance(picture, Image):
        H, W = picture.alpha.shape
        return {
            "kind": "picture",
            "size": [W, H],
            "opaque": float((picture.alpha == 1).mean()),
            "transparent": float((picture.alpha == 0).mean()),
            "mean_colour": picture.colour.mean(axis=(0, 1), dtype=np.float64).tolist(),
        }
    H, W = picture.distance.shape
    met = picture.distance[picture.distance > 0]
    return {
        "kind": "depth",
        "size": [W, H],
        "met": len(met) / picture.distance.size,
        "range": [float(met.min()), float(met.max())] if len(met) else None,
    }


def summary_of_splats(splats: Splats) -> dict[str, Any]:
    """Return the count, SH degree, boxes of the centres, and value ranges.

    inner_box holds 98 % of the centres along each axis: single splats often lie far outside. Boxes are in the world of
    the file, and None if a centre is not finite. Scales are standard deviations in world units.
    """
    with np.errstate(invalid="ignore"):
        inner = np.percentile(splats.means, [1, 99], axis=0) + splats.origin
    outer = np.stack([splats.means.min(axis=0), splats.means.max(axis=0)]).astype(np.float64) + splats.origin
    arrays = (splats.means, splats.scales, splats.quats, splats.opacity, splats.sh)
    return {
        "kind": "Gaussian splats",
        "splats": splats.n,
        "dropped_rows": splats.dropped,
        "sh_degree": splats.degree,
        "antialiased": splats.antialiased,
        "up": splats.up,
        "origin": splats.origin.tolist(),
        "world_box": _numbers(outer),
        "inner_box": _numbers(inner),
        "ranges": {
            "scale": extremes(splats.scales).range(),
            "opacity": extremes(splats.opacity[:, None]).range(),
            "dc": extremes(splats.sh[:, 0]).range(),
            "higher": extremes(splats.sh[:, 1:].reshape(splats.n, -1)).range() if splats.B > 1 else None,
        },
        "notes": list(splats.notes) or None,
        "bytes_in_memory": sum(array.nbytes for array in arrays),
    }


Known = (
    N3Tree
    | LatticeField
    | FunctionField
    | SparseVoxelOctree
    | Volume
    | Meshes
    | Cameras
    | Stage1
    | BakedAtlas
    | Image
    | Depth
    | EnvironmentMap
    | Splats
)


def summarise_scene(scene: Known) -> dict[str, Any]:
    """Return the facts of a scene as JSON types.

    For trees: kind, basis, resolution, nodes and leaves by level, world box, value ranges and size in memory. For a
    lattice field also colours, densities and notes on ignored data. For a trained field its network and boxes. For a
    volume the same per grid, and the file's kind
    of checksum. For a mesh triangles, pieces and colours. For cameras pictures, lenses and positions. For stage 1 and
    atlases textures, maps and errors. For splats counts, boxes and ranges.

    Ranges are [minimum, maximum] over the finite values of leaves with a density above 0, or None. Raises
    UsageError for a scene of another type.

    >>> from nerfbake import sample_n3tree, summarise_scene
    >>> facts = summarise_scene(sample_n3tree(resolution=8))
    >>> facts["kind"], facts["basis"], facts["dtype"]
    ('PlenOctree (N3Tree)', 'SH', 'float16')
    """
    if type(scene) not in _SUMMARIES:
        known = ", ".join(kind.__name__ for kind in _SUMMARIES)
        raise UsageError(f"{type(scene).__name__} has no summary; allowed: {known}")
    return _SUMMARIES[type(scene)](scene)


def _of_n3tree(tree: N3Tree) -> dict[str, Any]:
    leaves = tree.leaf_mask.reshape(tree.n, -1)
    data = tree.data.reshape(*leaves.shape, tree.data_dim)
    occupied, cells = leaves & (data[..., -1] > 0), data.reshape(-1, tree.data_dim)
    live = sum(map(len, tree.levels))
    with np.errstate(divide="ignore", invalid="ignore"):
        corners = (np.array([[0.0] * 3, [1.0] * 3]) - tree.offset) / tree.invradius
        half = 0.5**tree.shells
        inner = (np.array([[0.5 - half] * 3, [0.5 + half] * 3]) - tree.offset) / tree.invradius
    # A cell in a node of level d is a cube of level d + 1.
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
        "shells": tree.shells,
        "inner_box": None if tree.shells == 1 else _numbers(inner),
        "ranges": _ranges(extremes(cells, occupied.reshape(-1)), tree.data_format),
        "non_finite": extremes(cells, leaves.reshape(-1)).non_finite,
        "held_out": None if tree.held_out is None else str(tree.held_out),
        "notes": list(tree.notes) or None,
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
        ends = np.stack([box[0] - 0.5, box[1] + 0.5])  # a voxel extends half its edge around its centre
        corners = np.stack([ends[np.arange(8) >> axis & 1, axis] for axis in range(3)], axis=1)
        corners = transform_points(corners, transform)
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
    """Return the numbers as lists, or None if any is not finite, since JSON has no such numbers."""
    return values.tolist() if np.isfinite(values).all() else None


def _ranges(found: Extremes, data_format: str) -> dict[str, Any]:
    """Return the ranges of the density, of the first coefficient of each colour ('dc') and of all others ('higher')."""
    C = len(found.low)
    B = parse_basis(data_format).size if data_format else 1
    columns = np.arange(C - 1)
    return {
        "sigma": found.range(np.array([C - 1])),
        "dc": found.range(columns[columns % B == 0]),
        "higher": found.range(columns[columns % B != 0]),
    }


_SUMMARIES: dict[type, Callable[[Any], dict[str, Any]]] = {
    N3Tree: _of_n3tree,
    LatticeField: summary_of_lattice,
    FunctionField: summary_of_function,
    SparseVoxelOctree: _of_octree,
    Volume: _of_volume,
    Meshes: summary_of_meshes,
    Cameras: summary_of_cameras,
    Stage1: summary_of_stage1,
    BakedAtlas: summary_of_atlas,
    Image: summary_of_picture,
    Depth: summary_of_picture,
    EnvironmentMap: summary_of_light,
    Splats: summary_of_splats,
}
