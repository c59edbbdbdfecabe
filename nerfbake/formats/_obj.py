"""Wavefront .obj meshes with texture coordinates, read by trimesh."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
import trimesh

from nerfbake.errors import InvalidFile, MemoryLimit, Problem
from nerfbake.scene.mesh import TexturedMesh

_ALLOWED = "triangles with texture coordinates"
_EXPANSION = 10  # of a text file's bytes while trimesh reads it
_BROKEN = (ValueError, IndexError, KeyError, TypeError, AttributeError, NotImplementedError)


def decode_obj(view: memoryview, name: str, *, max_memory: int) -> TexturedMesh:
    """The mesh of an .obj file; vertices that meet different texture coordinates are split."""
    if (need := _EXPANSION * len(view)) > max_memory:
        raise MemoryLimit(name, need, max_memory)
    try:
        text = io.StringIO(bytes(view).decode())
        mesh = trimesh.load_mesh(text, file_type="obj", process=False, skip_materials=True)
        positions, faces = np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.uint32)
        uvs = np.array(getattr(mesh.visual, "uv", None), np.float32)
    except _BROKEN as error:
        raise InvalidFile(Problem(name, f"cannot be read ({error})", _ALLOWED)) from None
    if uvs.shape != (len(positions), 2):
        raise InvalidFile(Problem(name, "has no texture coordinates for its vertices", _ALLOWED))
    uvs[:, 1] = 1 - uvs[:, 1]  # .obj counts v from the bottom
    return TexturedMesh(positions, uvs, faces)


def encode_obj(mesh: TexturedMesh, material: str) -> Iterator[bytes]:
    """The mesh as text, with one material `defaultMat` from the file `material`."""
    yield f"mtllib {material}\nusemtl defaultMat\n".encode()
    for letter, rows in (("v", mesh.positions), ("vt", np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1))):
        lines = io.BytesIO()
        np.savetxt(lines, rows, fmt=letter + " %.7g" * rows.shape[1])
        yield lines.getvalue()
    lines = io.BytesIO()
    np.savetxt(lines, np.repeat(mesh.faces + 1, 2, axis=1), fmt="f %d/%d %d/%d %d/%d")
    yield lines.getvalue()
