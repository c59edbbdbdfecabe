"""What a .glb file's default scene shows, as meshes in its own coordinates. Nothing outside the file is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.wire.glb import Document, malformed, whole
from nerfbake.formats.wire.texture import decode_texture
from nerfbake.kernels.maths.affine import combined, determinant, placed
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.picture.srgb import from_linear
from nerfbake.scene.mesh import Mesh, require_few

_MATERIALS = "KHR_materials_"  # extensions of this name change how light is reflected, which is not looked at
_KNOWN = "KHR_mesh_quantization"
# What is beside triangles and their colours: lamps, moves, sounds and words about the file.
_BESIDE = {"KHR_lights_punctual", "EXT_lights_image_based", "EXT_lights_ies", "KHR_animation_pointer", "KHR_audio"}
_BESIDE |= {"KHR_xmp", "KHR_xmp_json_ld"}
MAX_NODES = 50_000
_MOVES = frozenset(("matrix", "rotation", "scale", "translation"))
_TRIANGLES, _STRIP, _FAN = 4, 5, 6

Floats = npt.NDArray[np.float64]


def decode_glb(view: memoryview) -> tuple[Mesh, ...]:
    """A mesh for each primitive of each node, with base colour, its texture and vertex colours; no lines and points.

    Raises InvalidFile for what is not sound glTF 2.0, needs another extension or another file, or has no triangles.
    """
    document = Document(view)
    for extension in _list(document.root, "extensionsRequired", "JSON"):
        if not (
            isinstance(extension, str)
            and (extension.startswith(_MATERIALS) or extension == _KNOWN or extension in _BESIDE)
        ):
            allowed = f"{_KNOWN}, {_MATERIALS}*, and what changes no triangle, such as KHR_lights_punctual"
            raise malformed("extensionsRequired", f"has {str(extension)[:40]}", allowed)
    looks = _Looks(document)
    found: list[Mesh] = []
    for index, matrix in _placed(document):
        mesh = document.item("meshes", index)
        for number, primitive in enumerate(_list(mesh, "primitives", f"meshes[{index}]")):
            place = f"meshes[{index}].primitives[{number}]"
            if not isinstance(primitive, dict):
                raise malformed(place, f"is a {type(primitive).__name__}", "an object")
            if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                found += _primitive(document, looks, primitive, matrix, place)
            require_few(len(found))
    if not found:
        raise malformed("the mesh", "has no faces", "at least one triangle")
    return tuple(found)


def _placed(document: Document) -> Iterator[tuple[Any, Floats]]:
    """The mesh of each node of the scene, and where it stands."""
    nodes = _list(document.root, "nodes", "JSON")
    if len(nodes) > MAX_NODES:
        raise malformed("nodes", f"are {len(nodes):,}", f"{MAX_NODES:,} at most")
    children = [_list(document.item("nodes", i), "children", f"nodes[{i}]") for i in range(len(nodes))]
    if _list(document.root, "scenes", "JSON"):
        roots = _list(document.item("scenes", document.root.get("scene", 0)), "nodes", "scenes")
    else:
        below = {child for each in children for child in each if type(child) is int}
        roots = [index for index in range(len(nodes)) if index not in below]
    seen: set[int] = set()
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise malformed(f"nodes[{index}]", "stands in the scene twice", "a tree of nodes")
        seen.add(index)
        matrix = above
        if not _MOVES.isdisjoint(node):
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = combined(above, _matrix(node, f"nodes[{index}]"))
        if "mesh" in node:
            yield node["mesh"], matrix
        waiting += [(child, matrix) for child in reversed(children[index])]


def _matrix(node: dict[str, Any], place: str) -> Floats:
    def numbers(key: str, *default: float) -> Floats:
        try:
            values = np.array(node.get(key, default), np.float64)
        except (ValueError, TypeError):
            values = np.empty(0)
        if values.shape != (len(default),) or not np.isfinite(values).all():
            raise malformed(f"{place}.{key}", "is no list of numbers", f"{len(default)} finite numbers")
        return values

    if "matrix" in node:
        return numbers("matrix", *np.eye(4).reshape(-1)).reshape(4, 4).T
    x, y, z, w = numbers("rotation", 0, 0, 0, 1)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * numbers("scale", 1, 1, 1)
    matrix[:3, 3] = numbers("translation", 0, 0, 0)
    return matrix


def _primitive(
    document: Document, looks: _Looks, primitive: dict[str, Any], matrix: Floats, place: str
) -> Iterator[Mesh]:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise malformed(f"{place}.attributes", "are missing", "an object with POSITION")
    points = document.accessor(attributes.get("POSITION"), ("VEC3",))
    if "indices" in primitive:
        indices = document.accessor(primitive["indices"], ("SCALAR",)).reshape(-1)
        if indices.dtype.kind != "u":
            raise malformed(f"{place}.indices", f"are {indices.dtype.name}", "whole numbers from 0")
    else:
        indices = np.arange(len(points), dtype=np.uint32)
    faces = _faces(indices.astype(np.uint32), primitive.get("mode", _TRIANGLES))
    if not len(faces):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        if determinant(matrix[:3, :3]) < 0:
            faces = faces[:, ::-1]  # mirrored: counter-clockwise from outside again
        if np.array_equal(matrix, np.eye(4)):  # as most nodes stand; ten times as fast
            positions = cast(points, np.float32) + np.float32(0)  # a zero without a sign, as sums of products have it
        else:
            positions = placed(cast(points, np.float64), matrix).astype(np.float32)
    mesh = Mesh(positions, None, np.ascontiguousarray(faces))
    yield looks.dress(mesh, primitive, attributes, place)


def _faces(indices: npt.NDArray[np.uint32], mode: int) -> npt.NDArray[np.uint32]:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return np.stack([np.repeat(indices[:1], max(len(indices) - 2, 0)), indices[1:-1], indices[2:]], axis=1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]  # every second triangle of a strip is the other way round
    return faces


class _Looks:
    """Materials; each picture is decoded once."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._textures: dict[int, npt.NDArray[np.uint8]] = {}

    def dress(self, mesh: Mesh, primitive: dict[str, Any], attributes: dict[str, Any], place: str) -> Mesh:
        """The mesh with its material. Factors are linear; their sRGB multiplies the texture's: nearly the same."""
        uvs, texture, light = None, None, np.ones((1, 3))
        surface: Any = {}
        if "material" in primitive:
            surface = self._document.item("materials", primitive["material"]).get("pbrMetallicRoughness", {})
        if not isinstance(surface, dict):
            raise malformed(f"{place}.material", "is no material", "pbrMetallicRoughness as an object")
        painted = "COLOR_0" in attributes or "baseColorFactor" in surface
        if "baseColorFactor" in surface:
            light = light * _colour(surface["baseColorFactor"], place)
        if "COLOR_0" in attributes:
            light = light * cast(self._document.accessor(attributes["COLOR_0"], ("VEC3", "VEC4"))[:, :3], np.float64)
        info = surface.get("baseColorTexture")
        if isinstance(info, dict) and (key := f"TEXCOORD_{info.get('texCoord', 0)}") in attributes:
            uvs = cast(self._document.accessor(attributes[key], ("VEC2",)), np.float32)
            texture = self._texture(info.get("index"))
        v = len(mesh.positions)
        if len(light) not in (1, v) or (uvs is not None and len(uvs) != v):
            raise malformed(place, "has attributes of different counts", f"{v:,} as POSITION")
        with np.errstate(invalid="ignore"):
            colours = np.broadcast_to(from_linear(light), mesh.positions.shape) if painted else None
        return replace(mesh, uvs=uvs, texture=texture, colours=colours)

    def _texture(self, index: Any) -> npt.NDArray[np.uint8]:
        source = whole(self._document.item("textures", index), "source", f"textures[{index}]")
        if source not in self._textures:
            image, place = self._document.item("images", source), f"images[{source}]"
            if "uri" in image:
                raise malformed(place, "is in another file", "pictures within the .glb")
            content = self._document.view(image.get("bufferView"))
            texture = decode_texture(content, place, any_mode=True)
            memory.hold(place, texture.nbytes)
            self._textures[source] = texture
        return self._textures[source]


def _colour(factor: Any, place: str) -> Floats:
    try:
        colour = np.array(factor, np.float64)
    except (ValueError, TypeError):
        colour = np.empty(0)
    if colour.shape != (4,) or not np.isfinite(colour).all():
        raise InvalidScene(Problem(f"{place}.material", "has no base colour", "4 finite numbers"))
    return colour[:3]


def _list(entry: dict[str, Any], key: str, place: str) -> list[Any]:
    found = entry.get(key, [])
    if not isinstance(found, list):
        raise malformed(f"{place}.{key}", f"is a {type(found).__name__}", "a list")
    return found
