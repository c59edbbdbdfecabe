"""Read and write meshes as binary glTF 2.0 (.glb).

    12 B header: "glTF", 2, total size | JSON chunk: size, "JSON", text, spaces | BIN chunk, if any: size, "BIN\0", data

The reader returns the meshes of the default scene, in the scene's coordinates. It reads nothing outside the file.

The writer is in glb_writer.py. Of a file with levels of detail (MSFT_lod), the finest is read.

Source: glTF 2.0, sections 3.6 and 4.4; KHR_mesh_quantization, KHR_texture_transform, EXT_texture_webp,
KHR_materials_pbrSpecularGlossiness, MSFT_lod.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.formats.mesh.colours import GREY, normalised, sound_colours
from nerfbake.formats.mesh.glb_document import (
    MESHOPT,
    Document,
    extension_of,
    inline,
    list_of,
    malformed,
    numbers_of,
    whole,
)
from nerfbake.formats.mesh.glb_writer import UP, encode_glb, parts_of
from nerfbake.formats.wire.json import kind_of, number
from nerfbake.formats.wire.picture import Coding, decode_cut_out
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, determinant, length, transform_points
from nerfbake.kernels.maths.elementary import cast, sine_cosine
from nerfbake.kernels.picture.metrics import from_linear, to_linear
from nerfbake.scene.mesh import Mesh, Meshes, require_few
from nerfbake.scene.origin import choose_origin, relative_to

_MATERIALS = "KHR_materials_"  # prefix of extensions that only change the reflection of light, which is ignored
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"  # holds the base colour under names of its own
_MOVED = "KHR_texture_transform"
_DRACO = "KHR_draco_mesh_compression"
_INSTANCES = "EXT_mesh_gpu_instancing"
_KNOWN = ("KHR_mesh_quantization", _MOVED, "EXT_texture_webp", *MESHOPT)
# Extensions that do not affect triangles and their colours: lights, animation, audio and metadata.
_BESIDE = {"KHR_lights_punctual", "EXT_lights_image_based", "EXT_lights_ies", "KHR_animation_pointer", "KHR_audio"}
_BESIDE |= {"KHR_xmp", "KHR_xmp_json_ld", "MSFT_lod"}
MAX_NODES = 50_000
_MOVES = frozenset(("matrix", "rotation", "scale", "translation"))
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def _meshes_of(document: Document) -> Meshes:
    """Return a mesh for each primitive of each node, with base colour, texture and vertex colours; and notes.


    The matrices of the nodes are applied in float64, so that meshes far from 0 keep their digits beside an origin.
    Lines and points are skipped. Raises InvalidFile for invalid glTF 2.0, for files that require another extension or
    another file, and for files without triangles.
    """
    for extension in list_of(document.root, "extensionsRequired", "JSON"):
        if not (
            isinstance(extension, str)
            and (extension.startswith(_MATERIALS) or extension in _KNOWN or extension in _BESIDE)
        ):
            known = f"{', '.join(_KNOWN)}, {_MATERIALS}*"
            allowed = f"{known}, and extensions that change no triangle, such as KHR_lights_punctual"
            raise malformed("extensionsRequired", f"has {str(extension)[:40]}", allowed)
    looks = _Looks(document)
    found: list[Mesh] = []
    placed: list[npt.NDArray[Any]] = []  # the positions of each mesh, in float64 unless they are as in the file
    for _, index, matrix in placed_meshes(document):
        mesh = document.item("meshes", index)
        for k, primitive in enumerate(list_of(mesh, "primitives", f"meshes[{index}]")):
            place = f"meshes[{index}].primitives[{k}]"
            if not isinstance(primitive, dict):
                raise malformed(place, f"is a {type(primitive).__name__}", "an object")
            if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                for points, made in _primitive(document, looks, primitive, matrix, place):
                    placed.append(points)
                    found.append(made)
            require_few(len(found))
    if not found:
        raise malformed("the mesh", "has no faces", "at least one triangle")
    if (origin := choose_origin(placed)).any():
        pairs = zip(found, placed, strict=True)
        found = [replace(mesh, positions=relative_to(points, origin)) for mesh, points in pairs]
    return Meshes(tuple(found), notes=(*_notes(document), *looks.notes), origin=origin)


def placed_meshes(document: Document) -> Iterator[tuple[int, Any, Floats]]:
    """Yield each node of the scene that has a mesh, the mesh, and its transform to the scene."""
    return placed_nodes(document, "mesh")


def placed_nodes(document: Document, key: Literal["mesh", "camera"]) -> Iterator[tuple[int, Any, Floats]]:
    """Yield each node of the scene that has this key, its value, and the transform (4, 4) of the node to the scene."""
    nodes = list_of(document.root, "nodes", "JSON")
    if len(nodes) > MAX_NODES:
        raise malformed("nodes", f"are {len(nodes):,}", f"{MAX_NODES:,} at most")
    children = [list_of(document.item("nodes", i), "children", f"nodes[{i}]") for i in range(len(nodes))]
    if list_of(document.root, "scenes", "JSON"):
        roots = list_of(document.item("scenes", document.root.get("scene", 0)), "nodes", "scenes")
    else:
        below = {child for each in children for child in each if type(child) is int}
        roots = [index for index in range(len(nodes)) if index not in below]
    seen: set[int] = set()
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise malformed(f"nodes[{index}]", "is in the scene twice", "a tree of nodes")
        seen.add(index)
        matrix = above
        if not _MOVES.isdisjoint(node):
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = compose(above, _matrix(node, f"nodes[{index}]"))
        if key in node:
            yield index, node[key], matrix
        waiting += [(child, matrix) for child in reversed(children[index])]


def _matrix(node: dict[str, Any], place: str) -> Floats:
    if "matrix" in node:
        return numbers_of(node, "matrix", place, *([0.0] * 16)).reshape(4, 4).T
    turn = numbers_of(node, "rotation", place, 0, 0, 0, 1)
    if not turn.any():
        raise malformed(f"{place}.rotation", "has length 0", "a quaternion of length 1")
    turn /= np.abs(turn).max()  # so that no square overflows
    x, y, z, w = turn / length(turn)
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = axes * numbers_of(node, "scale", place, 1, 1, 1)
    matrix[:3, 3] = numbers_of(node, "translation", place, 0, 0, 0)
    return matrix


def _primitive(
    document: Document, looks: _Looks, primitive: dict[str, Any], matrix: Floats, place: str
) -> Iterator[tuple[npt.NDArray[Any], Mesh]]:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise malformed(f"{place}.attributes", "are missing", "an object with POSITION")
    stored = document.item("accessors", attributes.get("POSITION"))
    if extension_of(primitive, _DRACO, place) is not None and "bufferView" not in stored:
        raise malformed(place, f"needs {_DRACO}", "triangles without this compression")
    points = document.accessor(attributes.get("POSITION"), ("VEC3",))
    if "indices" in primitive:
        indices = document.accessor(primitive["indices"], ("SCALAR",)).reshape(-1)
        if indices.dtype.kind != "u":
            raise malformed(f"{place}.indices", f"are {indices.dtype.name}", "whole numbers, 0 or more")
    else:
        indices = np.arange(len(points), dtype=np.uint32)
    faces = _faces(indices.astype(np.uint32), primitive.get("mode", _TRIANGLES))
    if not len(faces):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        if determinant(matrix[:3, :3]) < 0:
            faces = faces[:, ::-1]  # a mirrored node: restore counter-clockwise order from outside
        if np.array_equal(matrix, np.eye(4)):  # the most common case, and ten times as fast
            positions = cast(points, np.float32) + np.float32(0)  # positive zeros, as in the result of a matrix product
        else:
            points = transform_points(cast(points, np.float64), matrix)
            positions = cast(points, np.float32)
    mesh = Mesh(positions, None, np.ascontiguousarray(faces))
    yield points, looks.dress(mesh, primitive, attributes, place)


def _faces(indices: npt.NDArray[np.uint32], mode: int) -> npt.NDArray[np.uint32]:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return np.stack([np.repeat(indices[:1], max(len(indices) - 2, 0)), indices[1:-1], indices[2:]], axis=1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]  # every second triangle of a strip has the opposite orientation
    return faces


class _Looks:
    """The materials of a file; each picture is decoded once."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._textures: dict[int, tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None]] = {}
        self.notes: dict[str, None] = {}  # what was repaired

    def dress(self, mesh: Mesh, primitive: dict[str, Any], attributes: dict[str, Any], place: str) -> Mesh:
        """Return the mesh with its material.

        Factors are linear. They are converted to sRGB and multiply the sRGB texture, which is a close approximation.
        """
        uvs, texture, opaque, light = None, None, None, np.ones((1, 3))
        base = _Base(None, None, "")
        if "material" in primitive:
            index = primitive["material"]
            base = _base_of(self._document.item("materials", index), f"materials[{index}]")
        if base.factor is not None:
            light = light * base.factor
        if "COLOR_0" in attributes:
            stored = self._document.accessor(attributes["COLOR_0"], ("VEC3", "VEC4"))[:, :3]
            values, repaired = normalised(stored)
            values, notes = sound_colours(values, grey=float(to_linear(np.array(GREY))))
            light = light * values
            self.notes |= dict.fromkeys((*repaired, *notes))
        if isinstance(base.texture, dict):
            uvs = self._corners(base.texture, attributes, base.place)
            if uvs is not None:
                texture, opaque = self._texture(base.texture.get("index"))
        v = len(mesh.positions)
        if len(light) not in (1, v) or (uvs is not None and len(uvs) != v):
            raise malformed(place, "has attributes of different counts", f"{v:,}, as POSITION")
        painted = base.factor is not None or "COLOR_0" in attributes
        with np.errstate(invalid="ignore"):
            colours = np.broadcast_to(from_linear(light), mesh.positions.shape) if painted else None
        return replace(mesh, uvs=uvs, texture=texture, colours=colours, opaque=opaque if base.masked else None)

    def _corners(
        self, texture: dict[str, Any], attributes: dict[str, Any], place: str
    ) -> npt.NDArray[np.float32] | None:
        """Return the texture coordinates that a reference to a texture asks for; None if the mesh lacks them."""
        move, at = extension_of(texture, _MOVED, place), f"{place}.extensions.{_MOVED}"
        chosen = whole(move or {}, "texCoord", at, whole(texture, "texCoord", place, 0))
        if (key := f"TEXCOORD_{chosen}") not in attributes:
            return None
        uvs = self._document.accessor(attributes[key], ("VEC2",))
        if (wrong := np.isnan(uvs)).any():
            self.notes["texture coordinates that are not numbers are 0"] = None
            uvs = np.where(wrong, 0, uvs)
        return cast(uvs if move is None else _moved(uvs, move, at), np.float32)

    def _texture(self, index: Any) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None]:
        source = _source(self._document.item("textures", index), f"textures[{index}]")
        if source not in self._textures:
            image, place = self._document.item("images", source), f"images[{source}]"
            if "uri" in image:
                content = inline(image["uri"], place, "pictures inside the .glb")
            else:
                content = self._document.view(image.get("bufferView"))
            self._textures[source] = decode_cut_out(content, place)
        return self._textures[source]


def _source(texture: dict[str, Any], place: str) -> int:
    """Return the picture of a texture: its PNG or JPEG, or else its WebP."""
    webp = extension_of(texture, "EXT_texture_webp", place)
    if "source" not in texture and webp is not None:
        return whole(webp, "source", f"{place}.extensions.EXT_texture_webp")
    if "source" not in texture and isinstance(others := texture.get("extensions"), dict) and others:
        raise malformed(place, f"needs {str(next(iter(others)))[:60]}", "a picture in PNG, JPEG or WebP")
    return whole(texture, "source", place)


class _Base(NamedTuple):
    """The base colour of a material: its linear factor (3,), the reference to its texture, and that one's place.

    masked: an alpha below 1/2 in the texture is a hole, as with the default alphaCutoff.
    """

    factor: Floats | None
    texture: Any
    place: str
    masked: bool = False


def _base_of(material: dict[str, Any], place: str) -> _Base:
    surface, factor, texture = material.get("pbrMetallicRoughness", {}), "baseColorFactor", "baseColorTexture"
    at = f"{place}.pbrMetallicRoughness"
    if (glossy := extension_of(material, _GLOSSY, place)) is not None:
        surface, factor, texture, at = glossy, "diffuseFactor", "diffuseTexture", f"{place}.extensions.{_GLOSSY}"
    if not isinstance(surface, dict):
        raise malformed(at, f"is {kind_of(surface)}", "an object")
    light = numbers_of(surface, factor, at, 1, 1, 1, 1)[:3] if factor in surface else None
    return _Base(light, surface.get(texture), f"{at}.{texture}", material.get("alphaMode") == "MASK")


def _moved(uvs: npt.NDArray[Any], move: dict[str, Any], place: str) -> Floats:
    """Return scaled, then rotated, then shifted texture coordinates, (v, 2).

    The rotation is counter-clockwise where v points down, as the extension's text and its example say, and as other
    programs do. The matrix in its README has the other sign: github.com/KhronosGroup/glTF/issues/1563.
    """
    scale, shift = numbers_of(move, "scale", place, 1, 1), numbers_of(move, "offset", place, 0, 0)
    sine, cosine = sine_cosine(math.fmod(number(move, "rotation", place, default=0.0), math.tau))
    with np.errstate(over="ignore", invalid="ignore"):
        u, v = (cast(uvs, np.float64) * scale).T
        return np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1) + shift


def recognise(view: memoryview) -> bool:
    """Return True for glTF's magic number."""
    return bytes(view[:4]) == b"glTF"


def encode(
    scene: Meshes,
    *,
    up: Literal["y", "z"] = "y",
    lit: bool = False,
    image: Coding = "png",
    quantised: bool = False,
    reversible: bool = False,
) -> list[bytes | memoryview]:
    """Encode meshes. Options as in encode_glb() and parts_of()."""
    options: dict[str, Any] = {"up": up, "lit": lit, "quantised": quantised, "reversible": reversible}
    options["origin"] = scene.origin
    return encode_glb(parts_of(scene, image), "nerfbake", **options)


def decode(view: memoryview) -> Meshes:
    """Read meshes, in the coordinates of the field if the file records its up axis.

    Raises InvalidFile for invalid files or external data, InvalidScene for invalid mesh values.
    """
    document = Document(view)
    asset = document.root.get("asset")
    extras = asset.get("extras") if isinstance(asset, dict) else None
    turned = isinstance(extras, dict) and extras.get(UP) == "z"
    return _meshes_of(document).with_up("z" if turned else "y")


def _notes(document: Document) -> Iterator[str]:
    """Yield a line for poses that are not applied, and for copies that are left out."""
    nodes = list_of(document.root, "nodes", "JSON")
    if any("mesh" in node and "skin" in node for node in nodes):
        yield "skins are not read: the mesh has the pose that it was modelled in"
    if any("mesh" in node and extension_of(node, _INSTANCES, "nodes") is not None for node in nodes):
        yield f"copies by {_INSTANCES} are not read: each mesh is read once"
    meshes = [mesh for mesh in list_of(document.root, "meshes", "JSON") if isinstance(mesh, dict)]
    if any(isinstance(shares := mesh.get("weights"), list) and any(shares) for mesh in meshes):
        yield "morph targets are not read: the mesh has its basic shape"
