"""What `summarise_scene` tells of triangle meshes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.scene.mesh import Meshes, joined_meshes, vertex_box

# Bytes while edges are paired, as measured: a triangle has three edges, each in a few tables.
_PER_TRIANGLE, _PER_VERTEX = 300, 60


def summary_of_meshes(scene: Meshes) -> dict[str, Any]:
    """Triangles, box, colours, and the surface that all meshes of the file make together.

    pieces          how many parts of it touch each other nowhere
    closed          True if every edge has two triangles: a surface without holes and borders
    same_winding    True if triangles with an edge in common face the same side, wherever two have one

    Vertices at the same place are one here, since texture coordinates split them; triangles that are only a line or a
    point do not count. All three are None where --max-memory has no room to find out.
    """
    arrays = [(m.positions, m.faces, m.uvs, m.texture, m.colours) for m in scene.meshes]
    box = vertex_box(scene.meshes)
    return {
        "kind": "triangle mesh",
        "meshes": len(scene.meshes),
        "triangles": sum(len(mesh.faces) for mesh in scene.meshes),
        "vertices": sum(len(mesh.positions) for mesh in scene.meshes),
        **_surface(scene),
        "world_box": box.tolist(),
        "textures": [None if mesh.texture is None else list(mesh.texture.shape[1::-1]) for mesh in scene.meshes],
        "vertex_colours": [mesh.colours is not None for mesh in scene.meshes],
        "bytes_in_memory": sum(array.nbytes for parts in arrays for array in parts if array is not None),
    }


def _surface(scene: Meshes) -> dict[str, Any]:
    need = sum(_PER_TRIANGLE * len(mesh.faces) + _PER_VERTEX * len(mesh.positions) for mesh in scene.meshes)
    if need > memory.left():
        return {"pieces": None, "closed": None, "same_winding": None}
    from trimesh import graph  # it takes a while, and only meshes need it

    positions, corners, _ = joined_meshes(scene.meshes)
    faces = _places(positions)[corners]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if not len(faces):
        return {"pieces": 0, "closed": False, "same_winding": True}
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    closed, same_winding = graph.is_watertight(edges)
    labels = graph.connected_component_labels(edges)  # type: ignore[no-untyped-call]
    return {"pieces": len(np.unique(labels[faces[:, 0]])), "closed": closed, "same_winding": same_winding}


def _places(positions: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """(v,) a number for each vertex, 0, 1, 2, ...; vertices at exactly the same place have the same."""
    order = np.lexsort(positions.T)
    in_order = positions[order]
    numbers = np.empty(len(positions), np.int64)
    numbers[order[0]] = 0
    numbers[order[1:]] = np.cumsum((in_order[1:] != in_order[:-1]).any(axis=1))
    return numbers
