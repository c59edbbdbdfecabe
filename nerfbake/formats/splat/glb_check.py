"""Check splats in a .glb against KHR_gaussian_splatting: every rule that a reader relies on.

schemas/conformance has a file for each rule.

Source: KhronosGroup/glTF, KHR_gaussian_splatting; glTF 2.0, sections 3.6.2 and 3.7.2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.mesh.glb import placed_meshes
from nerfbake.formats.mesh.glb_document import Document, list_of
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, determinant
from nerfbake.kernels.soundness import plural

EXTENSION = "KHR_gaussian_splatting"
PREFIX = EXTENSION + ":"
_MOST = 100  # findings
_TYPES = {
    5120: "byte",
    5121: "unsigned byte",
    5122: "short",
    5123: "unsigned short",
    5125: "unsigned int",
    5126: "float",
}
_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COLOURS = ("srgb_rec709_display", "lin_rec709_display")
_KERNEL = "ellipse, or the kernel of an extension"
_NODE = "columns of finite lengths above 0 and at right angles, of a determinant above 0"
_RIGHT = 1e-3  # cosine of the angle between columns: rounding in files
_LEVELS = 4  # degrees of SH
_COEFFICIENT = re.compile(r"SH_DEGREE_([0-9]+)_COEF_([0-9]+)")
# How far the length of a quaternion may be from 1: Khronos' validator takes 0.005; four bytes may be off by 0.008.
_UNIT, _UNIT_OF_BYTES = 5e-3, 1e-2


class _Rule(NamedTuple):
    """What an attribute may be: its type, component types with `normalized`, and these in words."""

    kind: str
    stored: frozenset[tuple[int, bool]]
    allowed: str


_FLOATS = frozenset([(5126, False)])
_RULES = {
    "ROTATION": _Rule("VEC4", _FLOATS | {(5120, True), (5122, True)}, "VEC4 of float, or of normalised byte or short"),
    "SCALE": _Rule(
        "VEC3",
        _FLOATS | {(5121, True), (5121, False), (5123, True), (5123, False)},
        "VEC3 of float, or of unsigned byte or short, normalised or not",
    ),
    "OPACITY": _Rule(
        "SCALAR", _FLOATS | {(5121, True), (5123, True)}, "SCALAR of float, or of normalised unsigned byte or short"
    ),
}
_SH = _Rule("VEC3", _FLOATS, "VEC3 of float")


def examine(view: memoryview) -> list[Problem]:
    """Return what is wrong with the splats of a .glb, at most 100 findings. Raises InvalidFile if it is no .glb."""
    document = Document(view)
    found: list[Problem] = []
    for problem in _findings(document):
        found.append(problem)
        if len(found) >= _MOST:
            break
    return found


def _findings(document: Document) -> Iterator[Problem]:
    meshes = document.root.get("meshes")
    inner: set[str] = set()
    holders = set()
    for i, mesh in enumerate(meshes if isinstance(meshes, list) else []):
        primitives = mesh.get("primitives") if isinstance(mesh, dict) else None
        for j, primitive in enumerate(primitives if isinstance(primitives, list) else []):
            extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
            if isinstance(extensions, dict) and EXTENSION in extensions:
                holders.add(i)
                look = extensions[EXTENSION]
                others = look.get("extensions") if isinstance(look, dict) else None
                inner |= set(others) if isinstance(others, dict) else set()
                yield from _primitive(document, primitive, look, f"meshes[{i}].primitives[{j}]")
    if holders:
        yield from _extensions(document, inner)
        yield from _nodes(document, holders)


def _extensions(document: Document, inner: set[str]) -> Iterator[Problem]:
    used = list_of(document.root, "extensionsUsed", "JSON")
    for name in (EXTENSION, *sorted(inner)):
        if name not in used:
            yield Problem("extensionsUsed", f"lack {name[:60]}", "all extensions of the file")
    for name in list_of(document.root, "extensionsRequired", "JSON"):
        if name not in used:
            yield Problem("extensionsRequired", f"has {str(name)[:60]}", "some of extensionsUsed")


def _nodes(document: Document, holders: set[int]) -> Iterator[Problem]:
    """Yield nodes of splats whose matrix to the scene is not a rotation after scales above 0."""
    for node, mesh, matrix in placed_meshes(document):
        if type(mesh) is int and mesh in holders and (told := _wrong(matrix[:3, :3])):
            yield Problem(f"nodes[{node}]", told, _NODE)


def _wrong(linear: Floats) -> str:
    with np.errstate(all="ignore"):
        lengths = np.sqrt((linear * linear).sum(axis=0))
        if not np.isfinite(lengths).all():
            return "has numbers that are not finite"
        if not (lengths > 0).all():
            return "flattens splats"
        turn = linear / lengths
        if not np.abs(compose(turn.T.copy(), turn) - np.eye(3)).max() <= _RIGHT:
            return "shears splats"
    return "mirrors splats" if determinant(turn) < 0 else ""


def _primitive(document: Document, primitive: dict[str, Any], look: Any, place: str) -> Iterator[Problem]:
    if not isinstance(look, dict):
        yield Problem(f"{place}.{EXTENSION}", f"is a {type(look).__name__}", "an object")
        return
    if (mode := primitive.get("mode", 4)) != 0:
        yield Problem(f"{place}.mode", f"is {str(mode)[:20]}", "0, points")
    extended = bool(look.get("extensions"))
    yield from _properties(look, f"{place}.{EXTENSION}", extended)
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        yield Problem(f"{place}.attributes", "are missing", "an object")
        return
    if not extended:
        yield from _names(attributes, f"{place}.attributes")
    count = _count(document, attributes.get("POSITION"))
    for name in attributes:
        if name == "POSITION" or str(name).startswith(PREFIX):
            yield from _attribute(document, attributes[name], str(name), count, place, extended)


def _properties(look: dict[str, Any], place: str, extended: bool) -> Iterator[Problem]:
    """Yield wrong properties. An extension of the extension may define values of its own."""
    colours = " or ".join(_COLOURS)
    for key, values, allowed, required in (
        ("kernel", ("ellipse",), _KERNEL, True),
        ("colorSpace", _COLOURS, colours, True),
        ("projection", ("perspective",), "perspective", False),
        ("sortingMethod", ("cameraDistance",), "cameraDistance", False),
    ):
        if key not in look:
            if required:
                yield Problem(f"{place}.{key}", "is missing", allowed)
        elif look[key] not in values and not (extended and isinstance(look[key], str)):
            yield Problem(f"{place}.{key}", f"is {str(look[key])[:40]!r}", allowed)


def _names(attributes: dict[str, Any], place: str) -> Iterator[Problem]:
    """Yield attributes that are missing, and those that the kernel does not have."""
    for name in ("POSITION", *(PREFIX + own for own in _RULES)):
        if name not in attributes:
            yield Problem(place, f"lack {name}", "all attributes of the kernel ellipse")
    degrees = [0]
    for name in attributes:
        if str(name).startswith(PREFIX):
            own = str(name).removeprefix(PREFIX)
            match = _COEFFICIENT.fullmatch(own)
            known = own in _RULES or (match and int(match[1]) < _LEVELS and int(match[2]) <= 2 * int(match[1]))
            if not known:
                yield Problem(place, f"have {str(name)[:80]}", "the attributes of the kernel ellipse")
            elif match:
                degrees.append(int(match[1]))
    wanted = [
        f"{PREFIX}SH_DEGREE_{degree}_COEF_{m}" for degree in range(max(degrees) + 1) for m in range(2 * degree + 1)
    ]
    if missing := [name for name in wanted if name not in attributes]:
        yield Problem(place, f"lack {', '.join(missing)}", "all coefficients up to the highest degree")


def _count(document: Document, index: Any) -> int | None:
    """The number of splats that POSITION declares; None if it declares none."""
    try:
        count = document.item("accessors", index).get("count")
    except InvalidFile:
        return None
    return count if type(count) is int else None


def _attribute(
    document: Document, index: Any, name: str, count: int | None, place: str, extended: bool
) -> Iterator[Problem]:
    own, at = name.removeprefix(PREFIX), f"{place}.{name}"
    accessors = document.root.get("accessors")
    total = len(accessors) if isinstance(accessors, list) else 0
    if type(index) is not int or not 0 <= index < total:
        yield Problem(at, f"refers to accessor {str(index)[:20]}", f"one of {total:,}")
        return
    entry = document.item("accessors", index)
    if extended and "bufferView" not in entry:
        return  # an extension has the numbers
    kind, component = str(entry.get("type"))[:20], entry.get("componentType")
    told = component if type(component) is int else -1
    normalised = entry.get("normalized") is True
    rule = _RULES.get(own, _SH)
    if name != "POSITION" and (kind != rule.kind or (told, normalised) not in rule.stored):
        word = _TYPES.get(told, str(component)[:20])
        yield Problem(at, f"is {kind} of {'normalised ' * normalised}{word}", rule.allowed)
        return
    if (rows := entry.get("count")) != count and count is not None and type(rows) is int:
        yield Problem(at, f"has {plural(rows, 'row')}", f"{count:,}, as POSITION")
        return
    if start := _start(document, entry):
        yield Problem(at, f"starts at byte {start:,}", f"a multiple of {_size_of(entry)}")
        return
    try:
        with memory.scope():
            values = document.accessor(index, ("VEC3",) if name == "POSITION" else (rule.kind,))
            yield from _values(values, own, at, _UNIT_OF_BYTES if component == 5120 else _UNIT)
            yield from _bounds(document, entry, values, at, needed=name == "POSITION", normalised=normalised)
    except InvalidFile as error:
        yield error.problem._replace(place=at)


def _start(document: Document, entry: dict[str, Any]) -> int:
    """The first byte of an accessor in its buffer, if its component type does not allow it; else 0."""
    if "bufferView" not in entry:
        return 0
    view = document.item("bufferViews", entry["bufferView"])
    parts = view.get("byteOffset", 0), entry.get("byteOffset", 0)
    start = sum(part for part in parts if type(part) is int)
    return start if start % _size_of(entry) else 0


def _size_of(entry: dict[str, Any]) -> int:
    component = entry.get("componentType")
    return _SIZES.get(component, 1) if type(component) is int else 1


def _values(values: npt.NDArray[Any], own: str, place: str, unit: float) -> Iterator[Problem]:
    with np.errstate(all="ignore"):
        if own == "ROTATION":
            lengths = np.sqrt((values.astype(np.float64) ** 2).sum(axis=1))
            wrong = ~(np.abs(lengths - 1) <= unit)
            if wrong.any():
                row = int(np.argmax(wrong))
                told = f"{np.count_nonzero(wrong):,} of {plural(len(wrong), 'row')} of another length"
                yield Problem(place, f"has {told}, first {lengths[row]:.4g} in row {row:,}", "unit quaternions")
            return
        wrong, allowed = ~np.isfinite(values), "finite numbers"
        if own == "SCALE":
            wrong, allowed = wrong | ~(values >= 0), "0 or more"
        if own == "OPACITY":
            wrong, allowed = ~((values >= 0) & (values <= 1)), "0 to 1"
    if wrong.any():
        first = int(np.argmax(wrong))
        row = first // values.shape[1]
        told = f"{np.count_nonzero(wrong):,} of {plural(values.size, 'number')} outside"
        yield Problem(place, f"has {told}, first {values[row, first % values.shape[1]]:.4g} in row {row:,}", allowed)


def _bounds(
    document: Document, entry: dict[str, Any], values: npt.NDArray[Any], place: str, *, needed: bool, normalised: bool
) -> Iterator[Problem]:
    """Yield the minimum and the maximum of an accessor that are missing or not those of its numbers."""
    for key, real in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
        told = entry.get(key)
        if told is None:
            if needed:
                yield Problem(place, f"has no {key}", "min and max")
        elif normalised or not np.isfinite(real).all():
            continue  # bounds are those of the stored integers; other numbers have their own finding
        elif (
            not isinstance(told, list)
            or len(told) != len(real)
            or not all(type(each) in (int, float) for each in told)
            or not np.array_equal(np.array(told, np.float64).astype(values.dtype), real)
        ):
            yield Problem(place, f"has {key} {_listed(told)}", f"{_listed(real.tolist())}, as its numbers")


def _listed(numbers: Any) -> str:
    if not isinstance(numbers, list):
        return "without a list"
    return ", ".join(f"{each:.9g}" if type(each) in (int, float) else "?" for each in numbers[:4])
