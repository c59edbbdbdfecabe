"""Meshes as Wavefront .obj text; obj_reader reads it."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.scene.mesh import Mesh


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
