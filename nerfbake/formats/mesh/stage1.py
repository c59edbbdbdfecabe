"""nerf2mesh's stage-1 folder: mesh_{c}.obj and .mtl, feat0_{c} (diffuse), feat1_{c} (specular feature), mlp.json.

Textures are .jpg, or .png as older forks write them. mlp.json says how many cascades c there are. Feature textures and
MLP must be there; without meshes every texel counts as used. A transforms.json says where cameras stood.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.transforms_frames import decode_positions
from nerfbake.formats.mesh.mlp import Mlp, decode_mlp, encode_mlp
from nerfbake.formats.mesh.surface import decode_surface, encode_surface
from nerfbake.formats.wire.texture import decode_texture, encode_texture
from nerfbake.kernels.surface.raster import cover
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.specular import SpecularField
from nerfbake.scene.stage1 import Stage1


def recognise(files: Mapping[str, memoryview]) -> bool:
    return "mlp.json" in files


def decode(files: Mapping[str, memoryview]) -> Stage1:
    """Raises InvalidFile naming the first file that is missing or wrong, InvalidScene for arrays that do not fit."""
    mlp = decode_mlp(_require(files, "mlp.json"))
    fields: list[SpecularField] = []
    meshes: list[Mesh | None] = []
    handed_on: dict[str, bytes | memoryview] = {}
    for cascade in range(mlp.cascades):
        name = _texture_name(files, f"feat1_{cascade}")
        features = decode_texture(files[name], name)
        mesh = decode_surface(files, cascade)
        H, W, _ = features.shape
        used = cover(mesh.require_unwrapped(), mesh.faces, H, W) if mesh else np.ones((H, W), bool)
        fields.append(SpecularField(features, mlp.w0, mlp.w1, used))
        meshes.append(mesh)
        others = (f"mesh_{cascade}.obj", f"mesh_{cascade}.mtl", f"feat0_{cascade}.jpg", f"feat0_{cascade}.png")
        handed_on |= {other: files[other] for other in others if other in files}
    cameras = None
    if "transforms.json" in files:
        cameras = decode_positions(files["transforms.json"])
    return Stage1(tuple(fields), tuple(meshes), handed_on, cameras)


def encode(stage1: Stage1) -> Iterator[tuple[str, Iterable[bytes | memoryview]]]:
    """The files by name. Textures are PNGs, so that features stay exact; what came from files stays as it was."""
    first = stage1.fields[0]
    yield "mlp.json", [encode_mlp(Mlp(first.w0, first.w1, 1.0, len(stage1.fields)))]
    for cascade, field in enumerate(stage1.fields):
        yield f"feat1_{cascade}.png", [encode_texture(field.features)]
        yield from encode_surface(stage1.meshes[cascade], stage1.files, cascade)
    for name, content in stage1.files.items():
        yield name, [content]


def _require(files: Mapping[str, memoryview], name: str) -> memoryview:
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", "mlp.json and feat1_{c}.jpg or .png for every cascade"))
    return files[name]


def _texture_name(files: Mapping[str, memoryview], stem: str) -> str:
    there = [f"{stem}.{suffix}" for suffix in ("png", "jpg") if f"{stem}.{suffix}" in files]
    if len(there) != 1:
        found = "is there as .png and as .jpg" if there else "is missing"
        raise InvalidFile(Problem(stem, found, f"{stem}.jpg or {stem}.png"))
    return there[0]
