"""glTF 2.0 binaries (.glb) of meshes, textured ones unlit, with an octahedral atlas beside each.

    12 B header: "glTF", 2, total size | JSON chunk: size, "JSON", text, spaces | BIN chunk: size, "BIN\\0", data

Any viewer shows the diffuse texture. Atlas, labels and features are textures that no standard material slot names;
their indices stand with the atlas's conventions in the material's extras, under "nerfbake_atlas". Positions are the
field's own, whatever axis is up there: where it is not glTF's y, the nodes turn it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.picture.srgb import to_linear
from nerfbake.scene.mesh import Mesh

_FLOAT, _UINT32 = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_NEAREST, _LINEAR, _CLAMP, _REPEAT = 9728, 9729, 33071, 10497
_TURNS: dict[str, dict[str, Any]] = {"y": {}, "z": {"matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}}
_SAMPLERS = {"diffuse": 0, "atlas": 1, "labels": 2, "features": 2}


class Part(NamedTuple):
    """A mesh, its textures as PNG or JPEG by role ('diffuse', 'atlas', 'labels', 'features'), and its extras."""

    name: str
    mesh: Mesh
    textures: Mapping[str, bytes | memoryview]
    extras: Mapping[str, Any] | None = None


def encode_glb(parts: list[Part], generator: str, *, up: Literal["y", "z"] = "y") -> list[bytes | memoryview]:
    """The file in pieces. up: the axis of the positions that is glTF's y; for z nodes show (x, y, z) at (x, z, -y)."""
    body = _Body()
    for part in parts:
        body.add(part)
    document = {
        "asset": {"version": "2.0", "generator": generator},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        "nodes": [{"name": part.name, "mesh": i, **_TURNS[up]} for i, part in enumerate(parts)],
        "samplers": [
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _REPEAT, "wrapT": _REPEAT},
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP},
            {"magFilter": _NEAREST, "minFilter": _NEAREST, "wrapS": _REPEAT, "wrapT": _REPEAT},
        ],
        **{name: entries for name, entries in body.lists.items() if entries},
        "buffers": [{"byteLength": body.size}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + body.size
    head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
    return [head, text, struct.pack("<I4s", body.size, b"BIN\0"), *body.pieces]


class _Body:
    """The binary chunk, and the JSON lists that point into it."""

    def __init__(self) -> None:
        self.pieces: list[bytes | memoryview] = []
        self.size = 0
        names = ("meshes", "materials", "textures", "images", "accessors", "bufferViews")
        self.lists: dict[str, list[dict[str, Any]]] = {name: [] for name in names}

    def add(self, part: Part) -> None:
        textures = {role: self._texture(role, content, part.name) for role, content in part.textures.items()}
        surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
        material = {"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": True}
        if textures:
            material["extensions"] = {"KHR_materials_unlit": {}}
        if "diffuse" in textures:
            surface["baseColorTexture"] = {"index": textures.pop("diffuse")}
        if part.extras is not None:
            material["extras"] = {"nerfbake_atlas": {**part.extras, "textures": textures}}
        positions = part.mesh.positions
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        attributes = {"POSITION": self._accessor(positions, _FLOAT, "VEC3", _VERTICES, **bounds)}
        if part.mesh.uvs is not None:
            attributes["TEXCOORD_0"] = self._accessor(part.mesh.uvs, _FLOAT, "VEC2", _VERTICES)
        if part.mesh.colours is not None:
            attributes["COLOR_0"] = self._accessor(to_linear(part.mesh.colours), _FLOAT, "VEC3", _VERTICES)
        primitive = {
            "attributes": attributes,
            "indices": self._accessor(part.mesh.faces.reshape(-1), _UINT32, "SCALAR", _INDICES),
            "material": self._append("materials", material),
        }
        self._append("meshes", {"name": part.name, "primitives": [primitive]})

    def _texture(self, role: str, content: bytes | memoryview, name: str) -> int:
        kind = "image/png" if bytes(content[:4]) == b"\x89PNG" else "image/jpeg"
        view = self._append("bufferViews", self._view(content))
        image = self._append("images", {"name": f"{name} {role}", "bufferView": view, "mimeType": kind})
        return self._append("textures", {"sampler": _SAMPLERS[role], "source": image})

    def _accessor(self, array: npt.NDArray[Any], component: int, kind: str, target: int, **more: Any) -> int:
        content = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        view = self._append("bufferViews", {**self._view(content), "target": target})
        entry = {"bufferView": view, "componentType": component, "count": len(array), "type": kind, **more}
        return self._append("accessors", entry)

    def _view(self, content: bytes | memoryview) -> dict[str, Any]:
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(content)}
        padding = bytes(-len(content) % 4)
        self.pieces += [content, padding]
        self.size += len(content) + len(padding)
        return view

    def _append(self, name: str, entry: dict[str, Any]) -> int:
        self.lists[name].append(entry)
        return len(self.lists[name]) - 1
