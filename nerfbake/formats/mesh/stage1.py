"""Read and write nerf2mesh's stage-1 folders.

| file | content |
|---|---|
| mesh_{c}.obj, .mtl | the mesh of cascade c; optional: without meshes every texel counts as used |
| feat0_{c}.jpg or .png | diffuse texture |
| feat1_{c}.jpg or .png | texture of specular features |
| mlp.json | the weights as nested lists, `bound`, and `cascade`, the number of cascades |
| transforms.json | optional: the positions of the cameras |

Older forks write textures as .png.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.camera.transforms import decode_positions
from nerfbake.formats.mesh import mobilenerf
from nerfbake.formats.mesh.surface import decode_surface, encode_surface
from nerfbake.formats.wire.json import number, parse_object, shorten, table, whole
from nerfbake.formats.wire.picture import decode_texture, encode_texture
from nerfbake.kernels.surface.raster import covered_texels
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.stage1 import SpecularField, Stage1

MAX_CASCADES = 16
_NAME = "mlp.json"
FILES = re.compile(r"mlp\.json|feat1_\d+\.png|feat0_\d+\.(png|jpg)|mesh_\d+\.(obj|mtl)")


class MlpFile(NamedTuple):
    """w0 (6, h) and w1 (h, 3) float32. scene.stage1 checks their shapes and values."""

    w0: npt.NDArray[np.float32]
    w1: npt.NDArray[np.float32]
    cascades: int


def decode_mlp(view: memoryview) -> MlpFile:
    """Parse mlp.json."""
    content = parse_object(view, _NAME)
    cascades = whole(content, "cascade", _NAME, default=1, low=1, high=MAX_CASCADES)
    number(content, "bound", _NAME, default=1.0, low=1e-9, high=1e9)
    if extra := sorted(
        key for key in content if key.startswith("net.") and key not in ("net.0.weight", "net.1.weight")
    ):
        raise InvalidFile(
            Problem(_NAME, f"has {shorten(extra[0])}", "two layers without bias: net.0.weight and net.1.weight")
        )
    return MlpFile(_weights(content, "net.0.weight"), _weights(content, "net.1.weight"), cascades)


def encode_mlp(mlp: MlpFile) -> bytes:
    content = {
        "net.0.weight": mlp.w0.tolist(),
        "net.1.weight": mlp.w1.tolist(),
        "bound": 1.0,
        "cascade": mlp.cascades,
    }
    return json.dumps(content).encode()


def _weights(content: dict[str, Any], key: str) -> npt.NDArray[np.float32]:
    if key not in content:
        raise InvalidFile(Problem(_NAME, f"has no {key}", "net.0.weight and net.1.weight"))
    return table(content[key], f"{_NAME}: {key}", (None, None)).astype(np.float32)


def recognise(files: Mapping[str, memoryview]) -> bool:
    return "mlp.json" in files and not mobilenerf.recognise(files)


def decode(files: Mapping[str, memoryview]) -> Stage1:
    """Read a folder.

    Raises InvalidFile with the name of the first missing or wrong file, InvalidScene for arrays that do not match.
    """
    mlp = decode_mlp(_require(files, "mlp.json"))
    fields: list[SpecularField] = []
    meshes: list[Mesh | None] = []
    copied: dict[str, bytes | memoryview] = {}
    for cascade in range(mlp.cascades):
        name = _texture_name(files, f"feat1_{cascade}")
        features = decode_texture(files[name], name)
        mesh = decode_surface(files, cascade)
        H, W, _ = features.shape
        memory.hold(name, 2 * H * W)  # of the texels that are used
        used = covered_texels(mesh.require_unwrapped(), mesh.faces, H, W) if mesh else np.ones((H, W), bool)
        fields.append(SpecularField(features, mlp.w0, mlp.w1, used))
        meshes.append(mesh)
        others = (f"mesh_{cascade}.obj", f"mesh_{cascade}.mtl", f"feat0_{cascade}.jpg", f"feat0_{cascade}.png")
        copied |= {other: files[other] for other in others if other in files}
    cameras = None
    if "transforms.json" in files:
        cameras = decode_positions(files["transforms.json"])
    return Stage1(tuple(fields), tuple(meshes), copied, cameras)


def encode(stage1: Stage1) -> Iterator[tuple[str, Iterable[bytes | memoryview]]]:
    """Yield the files by name. Textures are PNGs, so that features stay exact; files that were read are copied.

    Raises InvalidScene for MobileNeRF's MLP, which these files cannot store.
    """
    first = stage1.fields[0]
    if first.channels != 3 or first.middle or first.biases:
        raise InvalidScene(Problem("the MLP", f"is {first.mlp_text}", "two layers without biases, of 3 features"))
    yield "mlp.json", [encode_mlp(MlpFile(first.w0, first.w1, len(stage1.fields)))]
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
        found = "exists as .png and as .jpg" if there else "is missing"
        raise InvalidFile(Problem(stem, found, f"{stem}.jpg or {stem}.png"))
    return there[0]
