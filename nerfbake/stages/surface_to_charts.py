"""Triangle surface -> texture coordinates: charts that are laid flat and packed into a square."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.surface import charts, packing
from nerfbake.kernels.surface.normals import doubled_areas, welded
from nerfbake.scene.mesh import Mesh

MAX_TEXTURE = 8192  # texels along an edge
_LEAST = 0.34  # cosine between a triangle and its chart: none is shortened to less than a third
_TRIANGLE_BYTES = 900  # while charts grow (700 measured)
_TEXEL_BYTES = 8


def unwrap_surface(mesh: Mesh, *, edge: int = 2048) -> Mesh:
    """Return the same triangles, in the same order, with texture coordinates for a texture of edge x edge texels.

    Every triangle has a place of its own in 0..1, v down, where no other triangle is. Charts have the scale of the
    surface, in all of the texture the same, up to what their projection shortens (most by less than a tenth, none to
    less than a third). No texel is read by bilinear lookups in two charts, and one more lies between them: finer
    levels of detail, and coordinates rounded to 16 bits, stay apart.

    Vertices are duplicated along seams and lose nothing else; vertices at the same place count as one. A texture that
    the mesh had is dropped, because it belongs to other coordinates. Time and memory are proportional to the number of
    triangles, however rough the surface is. Raises InvalidScene if the charts do not fit into the texture, MemoryLimit.

    >>> from nerfbake import build_field, build_hull, sample_n3tree, unwrap_surface
    >>> (hull,) = build_hull(build_field(sample_n3tree(resolution=16)), level=2).meshes
    >>> unwrapped = unwrap_surface(hull, edge=128)
    >>> same = unwrapped.positions[unwrapped.faces] == hull.positions[hull.faces]
    >>> bool(same.all()), float(unwrapped.uvs.max()) < 1
    (True, True)
    """
    require_texture(edge)
    memory.require("the charts of the mesh", _TRIANGLE_BYTES * len(mesh.faces) + _TEXEL_BYTES * edge * edge)
    positions = mesh.positions[mesh.faces].astype(np.float64)
    _, place = welded(mesh.positions)
    beside = charts.neighbours(place[mesh.faces].astype(np.uint32))
    flat = charts.flatten(positions, beside, least=_LEAST)
    order = np.argsort(flat.chart, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat.chart))])
    areas = doubled_areas(mesh.positions, mesh.faces) / 2
    texels = packing.pack(order, starts, flat.corners, areas, edge)
    if texels is None:
        found = f"is {edge} texels, too few for {len(starts) - 1:,} charts"
        raise InvalidScene(Problem("the texture's edge", found, "a larger texture, or a mesh of fewer triangles"))
    return memory.kept(_split(mesh, flat.chart, (texels / edge).astype(np.float32)))


def require_texture(edge: int) -> None:
    """Raise InvalidScene unless a texture's edge has 16 to MAX_TEXTURE texels."""
    if not 16 <= edge <= MAX_TEXTURE:
        raise InvalidScene(Problem("the texture's edge", f"is {edge}", f"16 to {MAX_TEXTURE:,} texels"))


def _split(mesh: Mesh, chart: npt.NDArray[np.int32], uvs: npt.NDArray[np.float32]) -> Mesh:
    """The mesh with these coordinates of its corners (t, 3, 2): one vertex for each vertex and chart that use it."""
    used = chart.astype(np.int64)[:, None] * len(mesh.positions) + mesh.faces
    _, first, faces = np.unique(used, return_index=True, return_inverse=True)
    source = mesh.faces.reshape(-1)[first]
    colours = None if mesh.colours is None else mesh.colours[source]
    at = uvs.reshape(-1, 2)[first]
    return Mesh(mesh.positions[source], at, faces.reshape(-1, 3).astype(np.uint32), None, colours)
