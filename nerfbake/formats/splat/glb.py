"""Read and write Gaussian splats as binary glTF 2.0 (.glb) with the extension KHR_gaussian_splatting.

A primitive of points has an accessor for each attribute:

    POSITION                                             centres
    KHR_gaussian_splatting:ROTATION                      x y z w; float, or normalised byte or short
    KHR_gaussian_splatting:SCALE                         standard deviations; in an early draft their logarithms
    KHR_gaussian_splatting:OPACITY                       0 to 1
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_m            red green blue; m = 0 to 2 l, l = 0 to 3
    COLOR_0                                              colour of degree 0 for viewers of points, linear

formats/mesh/glb.py describes the container. glTF's x points left, y up and z to the front; x and y change their signs
here. KHR_gaussian_splatting_compression_spz_2 has a whole .spz instead of the numbers. Files of nerfbake without
"nerfbake_front" in the extras of the asset have x right, y up and z back. The matrices of the nodes move the splats and
their colours. The origin of splats far from 0 is the translation of their node.

Source: KhronosGroup/glTF, KHR_gaussian_splatting and its pull request 2531; glTF 2.0, section 3.4.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.mesh.glb import placed_meshes
from nerfbake.formats.mesh.glb_document import MESHOPT, Document, malformed
from nerfbake.formats.mesh.glb_writer import opening_of
from nerfbake.formats.splat import spz
from nerfbake.formats.splat.glb_check import EXTENSION, PREFIX
from nerfbake.formats.splat.glb_check import examine as examine
from nerfbake.formats.splat.ply import exp_or_nan
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import transform_points
from nerfbake.kernels.picture.metrics import to_linear
from nerfbake.scene.basis import SH0
from nerfbake.scene.origin import choose_origin
from nerfbake.scene.splat_axes import from_axes, to_axes
from nerfbake.scene.splat_stretch import placed_by
from nerfbake.scene.splats import BASES, MOVING, Axes, SplatRows, Splats, join_splats, splats_in_blocks

MOST_DEGREE = 3
KEEPS_ORIGIN = True
KEEPS_UP = False
_HEAD = 20  # bytes before the JSON chunk
# The second one is the name in drafts.
_PACKED = (f"{EXTENSION}_compression_spz_2", f"{EXTENSION}_compression_spz")
_KNOWN = (EXTENSION, "KHR_mesh_quantization", *MESHOPT, *_PACKED)
_OF_MESHES = ("KHR_materials_", "KHR_texture_", "EXT_texture_")  # extensions of parts that are left out
_POINTS = 0
_FLOAT, _BYTE, _VERTICES = 5126, 5121, 34962
_DISPLAY, _LINEAR = "srgb_rec709_display", "lin_rec709_display"
_ANTIALIASED = "nerfbake_antialiased"
_FRONT, _PLUS_Z = "nerfbake_front", "+z"  # in the extras of the asset; files of before turned the scene to -z
_GLTF: Axes = "LUF"
_OF_BEFORE: Axes = "RUB"
_MANY = 1000  # primitives
_OURS = "nerfbake"  # generator
_GENERATOR = re.compile(r"splat-transform ([0-9]{1,4})\.([0-9]{1,4})")
_LINEAR_SINCE = (2, 7)  # playcanvas/splat-transform#268
_LOOKED_AT = 1 << 15  # splats
_DOUBTFUL = (0.05, 20.0)  # scales that may be logarithms of sizes from 1 unit up


def recognise(view: memoryview) -> bool:
    """Return True for a .glb that names the extension in its JSON chunk."""
    if bytes(view[:4]) != b"glTF":
        return False
    size = int.from_bytes(view[12:16], "little")
    return f'"{EXTENSION}'.encode() in bytes(view[_HEAD : _HEAD + size])


def decode(view: memoryview) -> Splats:
    """Read the splats of all nodes of the default scene. Raises InvalidFile, InvalidScene, MemoryLimit.

    Meshes in the file are left out with a note.
    """
    document = Document(view)
    required = document.root.get("extensionsRequired", [])
    for extension in required if isinstance(required, list) else [required]:
        if extension not in _KNOWN and not str(extension).startswith(_OF_MESHES):
            raise malformed("extensionsRequired", f"has {str(extension)[:60]}", ", ".join(_KNOWN))
    parts: list[tuple[Splats, Floats]] = []
    notes: dict[str, None] = {}
    for _, index, matrix in placed_meshes(document):
        primitives = document.item("meshes", index).get("primitives")
        for number, primitive in enumerate(primitives if isinstance(primitives, list) else []):
            place = f"meshes[{index}].primitives[{number}]"
            extension = _extension(primitive, place)
            if extension is None:
                notes["meshes in the file are left out"] = None
                continue
            if len(parts) >= _MANY:
                raise malformed("the file", f"has more than {_MANY:,} primitives of splats", f"{_MANY:,}")
            with np.errstate(over="ignore", invalid="ignore"):
                part = _splats(document, primitive, extension, place)
            if not np.array_equal(matrix, np.eye(4)):
                memory.hold("the splats", memory.size_of(part) + MOVING * part.n)
            parts.append((part, matrix))
    if not parts:
        raise malformed("the .glb", "has no splats", f"a primitive with {EXTENSION} in the scene")
    memory.hold("the splats", 2 * sum(memory.size_of(part) for part, _ in parts))
    axes, known = _axes(document.root.get("asset"))
    whole = replace(from_axes(placed_splats(parts), axes), axes_known=known, left_out=("meshes",) * bool(notes))
    return replace(whole, notes=(*whole.notes, *notes))


def _axes(asset: Any) -> tuple[Axes, bool]:
    """Return the axes of a file, and whether its program is known.

    They are those of glTF, but for files of nerfbake before it turned the front to +z.
    """
    generator = str(asset.get("generator", "")) if isinstance(asset, dict) else ""
    if generator != _OURS:
        return _GLTF, _GENERATOR.match(generator) is not None
    extras = asset.get("extras")
    return _GLTF if isinstance(extras, dict) and extras.get(_FRONT) == _PLUS_Z else _OF_BEFORE, True


def placed_splats(parts: list[tuple[Splats, Floats]]) -> Splats:
    """Return the splats of all nodes in the scene's coordinates, relative to its origin if it is far from 0.

    parts: splats in the coordinates of their node, and its matrix.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        origin = choose_origin([_points(part, matrix) for part, matrix in parts])
        moved = []
        for part, matrix in parts:
            near = matrix.copy()
            near[:3, 3] -= origin
            moved.append(part if np.array_equal(near, np.eye(4)) else placed_by(part, near[:3]))
    return replace(moved[0] if len(moved) == 1 else join_splats(moved), origin=origin)


def _points(part: Splats, matrix: Floats) -> npt.NDArray[Any]:
    """The means in the scene's coordinates: as they are stored if nothing moves them."""
    return part.means if np.array_equal(matrix, np.eye(4)) else transform_points(part.means, matrix)


def _extension(primitive: Any, place: str) -> dict[str, Any] | None:
    """Return the primitive's extension; None if it has none, and is no splats."""
    if not isinstance(primitive, dict):
        raise malformed(place, f"is a {type(primitive).__name__}", "an object")
    extensions = primitive.get("extensions")
    if not isinstance(extensions, dict) or EXTENSION not in extensions:
        return None
    found = extensions[EXTENSION]
    if not isinstance(found, dict) or primitive.get("mode", 4) != _POINTS:
        raise malformed(place, f"has {EXTENSION} without points", f"mode {_POINTS}, and an object")
    if "indices" in primitive:
        raise malformed(place, "has indices", "splats in the order of their attributes")
    return found


def _splats(document: Document, primitive: dict[str, Any], extension: dict[str, Any], place: str) -> Splats:
    """Return the splats of a primitive in the coordinates of its node."""
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise malformed(f"{place}.attributes", "are missing", "an object with POSITION")
    kernel = extension.get("kernel", "ellipse")
    space = extension.get("colorSpace", _DISPLAY)
    for key, value, allowed in (("kernel", kernel, ("ellipse",)), ("colorSpace", space, (_DISPLAY, _LINEAR))):
        if value not in allowed:
            raise malformed(f"{place}.{key}", f"is {str(value)[:40]}", " or ".join(allowed))
    notes = []
    if space == _LINEAR:
        notes.append("its colours are linear; they are kept as they are, and look too dark")

    others = extension.get("extensions")
    if isinstance(others, dict) and (name := next((name for name in _PACKED if name in others), None)):
        return _unpacked(document, others[name], f"{place}.{name}", tuple(notes))
    inner = str(next(iter(others)))[:60] if isinstance(others, dict) and others else None
    if inner is not None:
        notes.append(f"the extension {inner!r} is left out")

    def column(name: str, kind: str) -> npt.NDArray[Any]:
        index = attributes.get(name)
        # Attributes that an extension compresses have no bufferView, or have also one for programs without it.
        if inner is not None and (index is None or "bufferView" not in document.item("accessors", index)):
            raise malformed(place, f"needs {inner}", f"{EXTENSION} without further extensions")
        if index is None:
            raise malformed(f"{place}.attributes", f"lack {name}", f"POSITION, {PREFIX}ROTATION, SCALE, OPACITY, SH")
        with memory.scope():
            values = document.accessor(index, (kind,))
        if values.dtype == np.float64:  # normalised integers; other numbers are a view of the file
            memory.hold(f"{place}.{name}", values.nbytes)
        if len(values) != n and n:
            raise malformed(f"{place}.{name}", f"has {len(values):,} rows", f"{n:,}, as POSITION")
        return values

    n = 0
    means = column("POSITION", "VEC3")
    n = len(means)
    top = next((d for d in range(MOST_DEGREE, 0, -1) if f"{PREFIX}SH_DEGREE_{d}_COEF_0" in attributes), 0)
    names = [f"{PREFIX}SH_DEGREE_{degree}_COEF_{k}" for degree in range(top + 1) for k in range(2 * degree + 1)]
    coefficients = [column(name, "VEC3") for name in names]
    scales = column(PREFIX + "SCALE", "VEC3")
    turns, opacities = column(PREFIX + "ROTATION", "VEC4"), column(PREFIX + "OPACITY", "SCALAR")
    memory.require("the splats", 3 * n)
    logarithms, note = _scale_kind(scales, document.root.get("asset"))
    if note:
        notes.append(note)

    def rows(block: slice) -> SplatRows:
        def wide(values: npt.NDArray[Any]) -> Floats:
            return np.asarray(values[block], np.float64)

        sizes = wide(scales)
        sh = np.stack([wide(values) for values in coefficients], axis=1)
        return SplatRows(
            wide(means),
            exp_or_nan(sizes) if logarithms else sizes,
            wide(turns)[:, [3, 0, 1, 2]],
            wide(opacities)[:, 0],
            sh,
        )

    antialiased = isinstance(extras := primitive.get("extras"), dict) and extras.get(_ANTIALIASED) is True
    return splats_in_blocks(n, BASES[top], rows, antialiased=antialiased, notes=tuple(notes))


def _unpacked(document: Document, extension: Any, place: str, notes: tuple[str, ...]) -> Splats:
    """Return the splats of a whole .spz in a bufferView, in the coordinates of its node.

    The extension says that they are turned to glTF's axes when they are read.
    """
    if not isinstance(extension, dict):
        raise malformed(place, f"is a {type(extension).__name__}", "an object with a bufferView")
    splats = spz.decode(document.view(extension.get("bufferView")))
    told = tuple(note for note in splats.notes if note != spz.UNNAMED)
    return replace(to_axes(splats.with_degree(MOST_DEGREE), _GLTF), axes=None, axes_known=True, notes=(*notes, *told))


def _scale_kind(scales: npt.NDArray[Any], asset: Any) -> tuple[bool, str]:
    """Return whether scales are logarithms, and a note if they are, or if it cannot be told.

    An early draft of the extension had logarithms, and splat-transform wrote them up to 2.6. Negative ones are certain.
    Others, of a program that is not known, are in doubt if nearly all are numbers that logarithms of sizes from 1 unit
    up have: among the sizes of a scene in metres, some are nearly always far smaller.
    """
    generator = str(asset.get("generator", "")) if isinstance(asset, dict) else ""
    version = _GENERATOR.match(generator)
    if version is not None and (int(version[1]), int(version[2])) < _LINEAR_SINCE:
        return True, f"its scales are logarithms, as {version[0]} wrote them"
    if bool((scales < 0).any()):
        return True, "its scales are logarithms, as in an early draft of the extension"
    if version is not None or generator.startswith(_OURS):
        return False, ""
    some = scales[:: max(1, len(scales) // _LOOKED_AT)].astype(np.float64)
    low, high = (
        float(np.partition(some, k, axis=None).flat[k]) for k in (some.size // 100, some.size - 1 - some.size // 100)
    )
    if not (_DOUBTFUL[0] <= low and high <= _DOUBTFUL[1]):
        return False, ""
    return False, f"its scales, {low:.2g} to {high:.2g}, are read as sizes, but may be the logarithms of an early draft"


def encode(scene: Splats) -> Iterator[bytes]:
    """Encode splats without loss: 48 bytes, and 12 for each SH coefficient. Raises InvalidScene for SH of degree 4.

    The extension cannot tell that splats are antialiased; the primitive's extras do, for nerfbake.
    """
    if scene.degree > MOST_DEGREE:
        raise InvalidScene(Problem("sh", f"has degree {scene.degree}", f"0 to {MOST_DEGREE} in a .glb"))
    scene.require_usable()
    scene = to_axes(scene, _GLTF)
    n = scene.n
    bounds = {"min": scene.means.min(axis=0).tolist(), "max": scene.means.max(axis=0).tolist()}
    fields: list[tuple[str, str, int, dict[str, Any]]] = [
        ("POSITION", "VEC3", _FLOAT, bounds),
        ("COLOR_0", "VEC4", _BYTE, {"normalized": True}),
        (PREFIX + "ROTATION", "VEC4", _FLOAT, {}),
        (PREFIX + "SCALE", "VEC3", _FLOAT, {}),
        (PREFIX + "OPACITY", "SCALAR", _FLOAT, {}),
    ]
    for degree in range(scene.degree + 1):
        fields += [(f"{PREFIX}SH_DEGREE_{degree}_COEF_{k}", "VEC3", _FLOAT, {}) for k in range(2 * degree + 1)]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    attributes: dict[str, int] = {}
    size = 0
    for name, kind, component, more in fields:
        columns = 1 if kind == "SCALAR" else int(kind[3])
        length = n * columns * (1 if component == _BYTE else 4)
        views.append({"buffer": 0, "byteOffset": size, "byteLength": length, "target": _VERTICES})
        attributes[name] = len(accessors)
        accessors.append({"bufferView": len(accessors), "componentType": component, "count": n, "type": kind, **more})
        size += length
    look = {"kernel": "ellipse", "colorSpace": _DISPLAY, "sortingMethod": "cameraDistance", "projection": "perspective"}
    primitive: dict[str, Any] = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: look}}
    if scene.antialiased:
        primitive["extras"] = {_ANTIALIASED: True}
    document = {
        "asset": {"version": "2.0", "generator": _OURS, "extras": {_FRONT: _PLUS_Z}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "splats", "mesh": 0, **({"translation": scene.origin.tolist()} if scene.origin.any() else {})}
        ],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    yield from opening_of(document, size)
    yield scene.means.astype("<f4", copy=False).tobytes()
    yield _fallback(scene).tobytes()
    arrays = (scene.quats[:, [1, 2, 3, 0]], scene.scales, scene.opacity, *(scene.sh[:, k] for k in range(scene.B)))
    for array in arrays:
        yield array.astype("<f4", copy=False).tobytes()


def _fallback(scene: Splats) -> npt.NDArray[np.uint8]:
    """(n, 4) linear colours of degree 0, with the opacity."""
    colours = to_linear(np.clip(scene.sh[:, 0].astype(np.float64) * SH0 + 0.5, 0, 1))
    both = np.concatenate([colours, scene.opacity[:, None]], axis=1)
    return np.asarray(np.rint(both * 255), np.uint8)
