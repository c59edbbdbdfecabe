"""Read and write meshes in nerf2mesh folders: mesh_{c}.obj, mesh_{c}.mtl, and the diffuse texture feat0_{c}.

An alpha below 1/2 in the diffuse texture marks a hole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from nerfbake.formats.mesh.mtl import encode_mtl
from nerfbake.formats.mesh.obj import decode_obj, encode_obj
from nerfbake.formats.wire.picture import decode_cut_out, encode_texture
from nerfbake.scene.mesh import Mesh, joined_meshes
from nerfbake.scene.origin import no_origin
from nerfbake.scene.stage1 import diffuse_name

_MATERIAL = "defaultMat"


def decode_surface(files: Mapping[str, memoryview], cascade: int) -> Mesh | None:
    """Read the mesh with its diffuse texture, if present; None if there is no mesh.

    Raises InvalidFile for files that cannot be read, InvalidScene for a mesh without texture coordinates.
    """
    name, diffuse = f"mesh_{cascade}.obj", diffuse_name(files, cascade)
    if name not in files:
        return None
    parts = decode_obj(files[name], name).relative_to(no_origin()).meshes
    texture, opaque = decode_cut_out(files[diffuse], diffuse) if diffuse else (None, None)
    positions, faces, _ = joined_meshes(parts)
    return Mesh(positions, np.concatenate([part.require_uvs() for part in parts]), faces, texture, opaque=opaque)


def encode_surface(
    mesh: Mesh | None, files: Mapping[str, bytes | memoryview], cascade: int
) -> Iterator[tuple[str, Iterable[bytes | memoryview]]]:
    """Yield the files by name. Yields nothing if there is no mesh or if `files` already contains it."""
    if mesh is None or f"mesh_{cascade}.obj" in files:
        return
    yield f"mesh_{cascade}.obj", encode_obj([mesh], f"mesh_{cascade}.mtl", [_MATERIAL])
    holed = () if mesh.opaque is None else (_MATERIAL,)
    yield f"mesh_{cascade}.mtl", [encode_mtl([(_MATERIAL, f"feat0_{cascade}.png")], holed)]
    if mesh.texels is not None:
        yield f"feat0_{cascade}.png", [encode_texture(mesh.texels)]
