"""Wavefront .obj meshes, read by trimesh. Materials and textures stand in files of their own and are not looked for."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.scene.mesh import Mesh

_ALLOWED = "a whole .obj of polygons"
_EXPANSION = 10  # of a text file's bytes while trimesh reads it
_BROKEN = (ValueError, IndexError, KeyError, TypeError, AttributeError, NotImplementedError, RecursionError)


def decode_obj(view: memoryview, name: str) -> tuple[Mesh, ...]:
    """The meshes of an .obj file, one a material; vertices that meet different texture coordinates are split."""
    memory.require(name, _EXPANSION * len(view))
    try:
        text = io.StringIO(bytes(view).decode())
        scene = trimesh.load_scene(text, file_type="obj", process=False, skip_materials=True)
        found = [_mesh(geometry) for geometry in scene.geometry.values() if len(getattr(geometry, "faces", ()))]
    except _BROKEN as error:
        raise InvalidFile(Problem(name, f"cannot be read ({error})", _ALLOWED)) from None
    if not found:
        raise InvalidFile(Problem(name, "has no faces", "at least one triangle"))
    return tuple(found)


def _mesh(geometry: Any) -> Mesh:
    positions, faces = np.array(geometry.vertices, np.float32), np.array(geometry.faces, np.uint32)
    uvs, colours = getattr(geometry.visual, "uv", None), None
    if uvs is not None:
        uvs = np.array(uvs, np.float32)
        uvs[:, 1] = 1 - uvs[:, 1]  # .obj counts v from the bottom
    elif geometry.visual.kind == "vertex":
        colours = np.array(geometry.visual.vertex_colors[:, :3], np.float32) / np.float32(255)
    return Mesh(positions, uvs, faces, colours=colours)


def encode_obj(meshes: Sequence[Mesh], material: str | None = None) -> Iterator[bytes]:
    """The meshes as text. material: a file that describes `defaultMat`, which all of them then have."""
    if material:
        yield f"mtllib {material}\nusemtl defaultMat\n".encode()
    vertex, corner = 1, 1  # both are counted from 1, through the whole file
    for number, mesh in enumerate(meshes):
        if not material and len(meshes) > 1:
            yield f"usemtl mesh_{number}\n".encode()
        points = mesh.positions if mesh.colours is None else np.concatenate([mesh.positions, mesh.colours], axis=1)
        yield _lines("v" + " %.7g" * points.shape[1], points)
        faces = mesh.faces.astype(np.int64)
        if mesh.uvs is None:
            yield _lines("f %d %d %d", faces + vertex)
        else:
            yield _lines("vt %.7g %.7g", np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1))
            both = np.stack([faces + vertex, faces + corner], axis=2).reshape(-1, 6)
            yield _lines("f %d/%d %d/%d %d/%d", both)
            corner += len(mesh.uvs)
        vertex += len(points)


def _lines(form: str, rows: npt.NDArray[Any]) -> bytes:
    text = io.BytesIO()
    np.savetxt(text, rows, fmt=form)
    return text.getvalue()
