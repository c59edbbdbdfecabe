"""Write meshes as binary glTF 2.0 (.glb); glb.py draws the file.

The writer keeps the coordinates of the field. If the up axis is not glTF's y, the nodes rotate the meshes. Textured
meshes are unlit by default, and a mesh may have an octahedral atlas. Holes are alpha 0 in the texture, with the mode
MASK and the nearest texel. Any viewer shows the diffuse texture. Atlas,
labels and features are textures without a standard material slot; their indices and the conventions of the atlas are
in the material's extras, under "nerfbake_atlas". A mesh with a material is lit: metallicRoughnessTexture has roughness
in green and no metal in blue, and specularTexture of KHR_materials_specular has the specular strength in alpha.

Quantised attributes (KHR_mesh_quantization); each vertex starts at a multiple of 4 bytes:

    POSITION  x u16 | y u16 | z u16 | 0 u16    1/65535 of the longest edge of the box, which the node's matrix restores
    NORMAL    x i8  | y i8  | z i8  | 0 i8     normalised
    COLOR_0   r u16 | g u16 | b u16 | 0 u16    normalised, linear light
    TEXCOORD  u u16 | v u16                    normalised if all are in 0..1, else two f32

Positions are not normalised, because some readers (trimesh) do not divide them.

Coarser levels of detail are nodes outside the scene, to which MSFT_lod refers. They share one file, because that is
written completely or not at all, and because a viewer without the extension shows the finest level.

Source: glTF 2.0, sections 3.6 and 3.9; KHR_mesh_quantization, KHR_materials_unlit, KHR_materials_specular,
EXT_texture_webp, MSFT_lod.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire.picture import Coding, encode_picture, encode_texture
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, rotate
from nerfbake.kernels.picture.metrics import to_linear
from nerfbake.kernels.surface.normals import welded_normals
from nerfbake.scene.mesh import Mesh, Meshes

_BYTE, _USHORT, _FLOAT, _UINT32 = 5120, 5123, 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_NEAREST, _LINEAR, _CLAMP, _REPEAT = 9728, 9729, 33071, 10497
_TURNS: dict[str, dict[str, Any]] = {"y": {}, "z": {"matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}}
_SAMPLERS = {"diffuse": 0, "atlas": 1, "labels": 2, "features": 2, "roughness": 0, "specular": 0}
_MOST_SHORT = 0xFFFF  # vertices with 16-bit indices: 65,535 itself is glTF's primitive restart
UP = "nerfbake_up"  # in the extras of the asset
_UNLIT, _QUANTISED, _WEBP, _LOD = "KHR_materials_unlit", "KHR_mesh_quantization", "EXT_texture_webp", "MSFT_lod"
_SPECULAR = "KHR_materials_specular"


class MeshPart(NamedTuple):
    """A mesh, its pictures by role ('diffuse', 'atlas', 'labels', 'features', 'roughness', 'specular'), and its extras.

    coarser: the part is a level of detail of the first part, finer ones first.
    """

    name: str
    mesh: Mesh
    textures: Mapping[str, bytes | memoryview]
    extras: Mapping[str, Any] | None = None
    coarser: bool = False


def parts_of(scene: Meshes, image: Coding) -> list[MeshPart]:
    """The meshes of a scene and their coarser levels, with their textures as pictures."""

    def part(name: str, mesh: Mesh, coarser: bool) -> MeshPart:
        textures = {} if mesh.texels is None else {"diffuse": encode_picture(mesh.texels, image)}
        if mesh.material is not None:
            roughness, specular = mesh.material[..., :1], mesh.material[..., 1:]
            none, white = np.zeros_like(roughness), np.full((*roughness.shape[:2], 3), 255, np.uint8)
            # Without losses: these are data, of few values.
            textures["roughness"] = encode_texture(np.concatenate([none, roughness, none], axis=2))
            textures["specular"] = encode_texture(np.concatenate([white, specular], axis=2))
        return MeshPart(name, mesh, textures, coarser=coarser)

    found = [part(f"mesh {number}", mesh, False) for number, mesh in enumerate(scene.meshes)]
    return found + [part(f"level {number}", mesh, True) for number, mesh in enumerate(scene.coarser, 1)]


def encode_glb(
    parts: Sequence[MeshPart],
    generator: str,
    *,
    up: Literal["y", "z"] = "y",
    lit: bool = False,
    quantised: bool = False,
    reversible: bool = False,
    origin: Floats | None = None,
) -> list[bytes | memoryview]:
    """Return the file in chunks.

    up          the up axis of the positions. glTF's is y; for "z" the nodes map (x, y, z) to (x, z, -y)
    reversible  record the up axis in the extras of the asset, so that nerfbake reads the positions as they are here
    lit         textures are the base colour of a rough material, with normals; False: unlit (KHR_materials_unlit).
                A mesh with a material is always lit
    origin      what the positions are relative to: the translation of the nodes, in the doubles of JSON; None for 0
    quantised   positions, texture coordinates, colours and normals are integers, and indices have 16 bits if possible
    """
    lit = lit or any(part.mesh.material is not None for part in parts)
    body = _Body(lit=lit, quantised=quantised)
    nodes = [_shifted(body.add(part, _TURNS[up]), _TURNS[up], origin) for part in parts]
    levels = [i for i, part in enumerate(parts) if part.coarser]
    if levels:
        nodes[0]["extensions"] = {_LOD: {"ids": levels}}
        body.used.add(_LOD)
    if not lit:
        body.used.add(_UNLIT)
    extras = {"extras": {UP: up}} if reversible else {}
    document = {
        "asset": {"version": "2.0", "generator": generator, **extras},
        "extensionsUsed": sorted(body.used),
        "extensionsRequired": sorted(body.used & {_QUANTISED, _WEBP}),
        "scene": 0,
        "scenes": [{"nodes": [i for i in range(len(parts)) if i not in levels]}],
        "nodes": nodes,
        "samplers": [
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _REPEAT, "wrapT": _REPEAT},
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP},
            {"magFilter": _NEAREST, "minFilter": _NEAREST, "wrapS": _REPEAT, "wrapT": _REPEAT},
        ],
        **body.lists,
        "buffers": [{"byteLength": body.size}],
    }
    document = {name: entry for name, entry in document.items() if entry != []}
    return [*opening_of(document, body.size), *body.pieces]


def _shifted(node: dict[str, Any], turn: Mapping[str, Any], origin: Floats | None) -> dict[str, Any]:
    """Return the node of a mesh whose positions are relative to an origin. turn: the rotation of the node."""
    if origin is None or not origin.any():
        return node
    place = rotate(origin, _matrix_of(turn)[:3, :3])
    if "matrix" not in node:
        return {**node, "translation": place.tolist()}
    matrix = _matrix_of(node)
    matrix[:3, 3] += place
    return {**node, "matrix": matrix.T.reshape(-1).tolist()}


def _matrix_of(node: Mapping[str, Any]) -> Floats:
    return np.array(node.get("matrix", np.eye(4).reshape(-1)), np.float64).reshape(4, 4).T.copy()


def opening_of(document: dict[str, Any], body_size: int) -> list[bytes]:
    """Return what stands before the bytes of the binary chunk: the header, and the document as the JSON chunk."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + body_size
    head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
    return [head, text, struct.pack("<I4s", body_size, b"BIN\0")]


class _Body:
    """The binary chunk, the JSON lists that refer to it, and the extensions that they use."""

    def __init__(self, *, lit: bool, quantised: bool) -> None:
        self.pieces: list[bytes | memoryview] = []
        self.size = 0
        self.used: set[str] = set()
        self._lit, self._quantised = lit, quantised
        names = ("meshes", "materials", "textures", "images", "accessors", "bufferViews")
        self.lists: dict[str, list[dict[str, Any]]] = {name: [] for name in names}

    def add(self, part: MeshPart, turn: Mapping[str, Any]) -> dict[str, Any]:
        """Add a mesh with its material, and return its node. turn: the rotation of the node."""
        mesh, material = part.mesh, self._material(part)
        attributes, matrix = self._places(mesh.positions)
        if self._lit:
            attributes["NORMAL"] = self._normals(mesh)
        if mesh.uvs is not None:
            attributes["TEXCOORD_0"] = self._corners(mesh.uvs)
        if mesh.colours is not None:
            attributes["COLOR_0"] = self._colours(mesh.colours)
        primitive = {
            "attributes": attributes,
            "indices": self._indices(mesh.faces, len(mesh.positions)),
            "material": self._append("materials", material),
        }
        index = self._append("meshes", {"name": part.name, "primitives": [primitive]})
        node: dict[str, Any] = {"name": part.name, "mesh": index, **turn}
        if matrix is not None:
            node["matrix"] = compose(_matrix_of(turn), matrix).T.reshape(-1).tolist()
        return node

    def _material(self, part: MeshPart) -> dict[str, Any]:
        holed = part.mesh.opaque is not None
        textures = {role: self._texture(role, content, part.name, holed) for role, content in part.textures.items()}
        surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
        material = {"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": True}
        if textures and not self._lit:
            material["extensions"] = {_UNLIT: {}}
        if holed:
            material |= {"alphaMode": "MASK", "alphaCutoff": 0.5}
        if "diffuse" in textures:
            surface["baseColorTexture"] = {"index": textures.pop("diffuse")}
        if "roughness" in textures:
            surface["metallicRoughnessTexture"] = {"index": textures.pop("roughness")}
            material["extensions"] = {_SPECULAR: {"specularTexture": {"index": textures.pop("specular")}}}
            self.used.add(_SPECULAR)
        if part.extras is not None:
            material["extras"] = {"nerfbake_atlas": {**part.extras, "textures": textures}}
        return material

    def _places(self, positions: npt.NDArray[np.float32]) -> tuple[dict[str, int], Floats | None]:
        """Add the positions; return their accessor, and the matrix that restores quantised ones."""
        matrix = None
        if self._quantised:
            low, high = (end(axis=0).astype(np.float64) for end in (positions.min, positions.max))
            step = max(float((high - low).max()), 1e-30) / 0xFFFF
            positions = np.rint((positions - low) / step).astype(np.uint16)
            matrix = np.diag([step, step, step, 1.0])
            matrix[:3, 3] = low
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        if matrix is None:
            return {"POSITION": self._accessor(positions, _FLOAT, "VEC3", _VERTICES, **bounds)}, None
        return {"POSITION": self._integers(positions, _USHORT, **bounds)}, matrix

    def _normals(self, mesh: Mesh) -> int:
        normals = welded_normals(mesh.positions, mesh.faces)
        if not self._quantised:
            return self._accessor(normals, _FLOAT, "VEC3", _VERTICES)
        return self._integers(np.rint(127 * normals).astype(np.int8), _BYTE, normalized=True)

    def _corners(self, uvs: npt.NDArray[np.float32]) -> int:
        if self._quantised and uvs.min() >= 0 and uvs.max() <= 1:
            return self._integers(np.rint(uvs.astype(np.float64) * 0xFFFF).astype(np.uint16), _USHORT, normalized=True)
        return self._accessor(uvs, _FLOAT, "VEC2", _VERTICES)

    def _colours(self, colours: npt.NDArray[np.float32]) -> int:
        light = to_linear(colours)
        if not self._quantised:
            return self._accessor(light, _FLOAT, "VEC3", _VERTICES)
        return self._integers(np.rint(light.astype(np.float64) * 0xFFFF).astype(np.uint16), _USHORT, normalized=True)

    def _indices(self, faces: npt.NDArray[np.uint32], vertices: int) -> int:
        if self._quantised and vertices <= _MOST_SHORT:
            return self._accessor(faces.reshape(-1).astype(np.uint16), _USHORT, "SCALAR", _INDICES)
        return self._accessor(faces.reshape(-1), _UINT32, "SCALAR", _INDICES)

    def _integers(self, array: npt.NDArray[Any], component: int, **more: Any) -> int:
        """Add integers (v, 2) or (v, 3), each vertex padded to a multiple of 4 bytes. more: of the accessor."""
        self.used.add(_QUANTISED)
        count, columns = array.shape
        width = columns * array.itemsize
        stride = width + -width % 4
        rows = np.zeros((count, stride // array.itemsize), array.dtype)
        rows[:, :columns] = array
        place = {} if stride == width else {"byteStride": stride}
        return self._accessor(rows, component, f"VEC{columns}", _VERTICES, place, **more)

    def _texture(self, role: str, content: bytes | memoryview, name: str, holed: bool) -> int:
        start = bytes(content[:4])
        kind = {b"\x89PNG": "png", b"RIFF": "webp"}.get(start, "jpeg")
        view = self._append("bufferViews", self._view(content))
        image = self._append("images", {"name": f"{name} {role}", "bufferView": view, "mimeType": f"image/{kind}"})
        sampler = _SAMPLERS["labels"] if holed and role == "diffuse" else _SAMPLERS[role]
        entry: dict[str, Any] = {"sampler": sampler, "source": image}
        if kind == "webp":
            self.used.add(_WEBP)
            entry = {"sampler": sampler, "extensions": {_WEBP: {"source": image}}}
        return self._append("textures", entry)

    def _accessor(
        self,
        array: npt.NDArray[Any],
        component: int,
        kind: str,
        target: int,
        place: Mapping[str, int] | None = None,
        **more: Any,
    ) -> int:
        content = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        view = self._append("bufferViews", {**self._view(content), **(place or {}), "target": target})
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
