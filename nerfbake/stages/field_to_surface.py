"""Radiance field -> its surface as one mesh of triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Faces, Floats, Points
from nerfbake.kernels.maths.affine import determinant, transform_points
from nerfbake.kernels.surface.cubes import march_cubes
from nerfbake.kernels.surface.triangles import compacted, parts_of, smoothed
from nerfbake.scene.camera import Cameras
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.stages._sampled_surface import SampledSurface, sample_surface
from nerfbake.stages.mesh_to_mesh import simplify_surface

_ISLAND = 100  # triangles of the lattice: a part with fewer is noise, unless it is the largest one
_ROUNDS = 10  # of smoothing


def build_surface(
    field: RadianceField,
    cameras: Cameras,
    *,
    triangles: int = 50_000,
    box: Points | None = None,
    largest: bool = False,
) -> Mesh:
    """Return the surface of a field as those cameras see it, with at most about `triangles` triangles.

    Positions are float32 in the world, faces counter-clockwise seen from outside, vertices are shared; there are no
    texture coordinates. cameras: those of the photographs, or others around the scene; their lenses are ignored.
    box (2, 3): lowest and highest corner in the world; what is outside is left out. largest: keep the largest
    connected part alone.

    The surface is a level of a weighted mix of the distance to where half of the light is lost, fused over the views,
    and the opacity of the cells. The level is the one whose silhouettes are nearest to the field's own. Surfaces
    without any density behind them, which close space that no camera saw, and small islands are removed. Raises
    InvalidScene for a field without a surface, MemoryLimit.

    >>> from nerfbake import build_field, build_surface, sample_n3tree, scatter_cameras
    >>> field = build_field(sample_n3tree(resolution=32))
    >>> mesh = build_surface(field, scatter_cameras(field, frames=8, edge=48), triangles=500)
    >>> len(mesh.faces) <= 500
    True
    """
    require_field(field)
    if box is not None:
        field = _cropped(field, box)
    with progress.part(0, 0.8), memory.scope():
        sampled = sample_surface(field, cameras)
        positions, faces = march_cubes(sampled.top, sampled.places, sampled.values, sampled.level)
        positions, faces = _without_lids(positions, faces, sampled)
        positions, faces = _without_islands(positions, faces, largest)
    positions = transform_points(smoothed(positions, faces, _ROUNDS), sampled.world)
    if determinant(sampled.world[:, :3]) < 0:
        faces = faces[:, ::-1]
    progress.report(0.9)
    return simplify_surface(
        Mesh(positions.astype(np.float32), None, np.ascontiguousarray(faces, np.uint32)), triangles=triangles
    )


def _cropped(field: RadianceField, box: Points) -> RadianceField:
    """The field with the part of its box that is in this box of the world."""
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = transform_points(corners, field.place)
    low, high = np.maximum(cells.min(axis=0), field.box[0]), np.minimum(cells.max(axis=0), field.box[1])
    if not (low < high).all():
        raise InvalidScene(Problem("the box", "contains no part of the field", "a box that overlaps it"))
    return replace(field, box=np.stack([np.floor(low), np.ceil(high)]))


def _without_lids(positions: Floats, faces: Faces, sampled: SampledSurface) -> tuple[Floats, Faces]:
    """Drop triangles that are near no dense cell."""
    held = sampled.supported(positions)[faces].any(axis=1)
    if not held.any():
        raise InvalidScene(Problem("the field", "has no surface that a camera sees", "a dense object in view"))
    return compacted(positions, faces[held])


def _without_islands(positions: Floats, faces: Faces, largest: bool) -> tuple[Floats, Faces]:
    part = parts_of(faces, len(positions))
    size = np.bincount(part)
    kept = np.zeros(len(size), bool) if largest else size >= _ISLAND
    kept[np.argmax(size)] = True
    return compacted(positions, faces[kept[part]])
