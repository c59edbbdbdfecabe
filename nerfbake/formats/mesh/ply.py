r"""Read and write meshes as .ply: positions, vertex colours, polygons.

    ply\n format binary_little_endian 1.0\n
    element vertex V\n property float x\n ... y\n ... z\n property uchar red\n ... green\n ... blue\n
    element face T\n property list uchar int vertex_indices\n end_header\n
    V rows of 3 f32 (and 3 u8) | T rows of u8 3, 3 i32

Colours are sRGB; their type decides whether they go to 1 (float), 65,535 (ushort) or 255 (other integers). The reader
takes text and both byte orders, other properties in any order, and polygons of any size. Textures and colours of faces
are left out with a note. Files with f_dc_0 or packed_position are splats, which splat/ply.py reads, as are files
without faces.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.wire import ply as wire
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.surface.fans import fan
from nerfbake.scene.mesh import Mesh, Meshes, rounding_notes

_ALLOWED = "a whole .ply of polygons"
_HEAD = 1 << 14  # bytes in which a mesh is recognised
_WORD = 90  # bytes of memory per word of text
_VERTEX = 60  # and per vertex
_CORNER = 60  # and per corner of a polygon
_TRIANGLE = 40  # and per corner while its polygon becomes triangles
_INDICES = ("vertex_indices", "vertex_index")
_TOLD = 60  # characters of a name in a note
_RGB = ("red", "green", "blue")
_GREY = 0.75  # of a mesh without colours beside one with colours


def recognise(view: memoryview) -> bool:
    """Return True for a header with faces, and without the properties of splats."""
    head, _, _ = bytes(view[:_HEAD]).partition(b"end_header")
    return wire.recognise(view) and b"\nelement face " in head and b" f_dc_0" not in head and b" packed_" not in head


def decode(view: memoryview) -> Meshes:
    """Parse a mesh. Raises InvalidFile, InvalidScene for invalid mesh values, MemoryLimit."""
    header = wire.parse_header(view)
    tables: dict[str, Any] = {}
    if header.kind == wire.TEXT:
        memory.hold("the mesh", _WORD * (len(view) - header.end) // 2)
        try:
            body: Any = np.array(bytes(view[header.end :]).split(), np.float64)
        except ValueError:
            raise InvalidFile(Problem("the mesh", "has words that are no numbers", _ALLOWED)) from None
    else:
        body = np.frombuffer(view, np.uint8)[header.end :]
    for element in header.elements:
        if {"vertex", "face"} <= set(tables):
            break
        read = _text_rows if header.kind == wire.TEXT else _binary_rows
        tables[element.name], body = read(element, body, wire.ORDERS.get(header.kind, "<"))
    if "vertex" not in tables or "face" not in tables:
        missing = "vertex" if "vertex" not in tables else "face"
        raise InvalidFile(Problem("the mesh", f"has no element {missing}", _ALLOWED))
    positions = _columns(tables["vertex"], ("x", "y", "z"))
    colours = _colours(tables["vertex"], header)
    faces = tables["face"]
    if not isinstance(faces, _Polygons):
        raise InvalidFile(Problem("element face", "has no list vertex_indices", _ALLOWED))
    with np.errstate(over="ignore", invalid="ignore"):
        mesh = Mesh(positions.astype(np.float32), None, faces.triangles(len(positions)), colours=colours)
    return Meshes((mesh,), notes=(*_notes(header, colours is None), *rounding_notes(positions)))


def _notes(header: wire.Header, grey: bool) -> Iterator[str]:
    """Yield a line for a texture, and one for colours of faces if the vertices have none."""
    words = (comment.partition(" ") for comment in header.comments)
    if pictures := [name for word, _, name in words if word == "TextureFile"]:
        yield f"texture {pictures[0][:_TOLD]!r} is not read from a .ply, but from a .glb or .obj"
    of_faces = {each.name for element in header.elements if element.name == "face" for each in element.properties}
    if grey and {*_RGB} <= of_faces:
        yield "colours of faces are not read, but colours of vertices"


class _Polygons:
    """The corners of all polygons, one after the other, and the number of corners of each."""

    def __init__(self, corners: Ints, counts: Ints) -> None:
        self._corners, self._counts = corners, counts

    def triangles(self, vertices: int) -> npt.NDArray[np.uint32]:
        if not len(self._counts):
            raise InvalidFile(Problem("the mesh", "has no faces", "at least one triangle"))
        if (self._counts < 3).any():
            found = f"has a face of {self._counts[(self._counts < 3).argmax()]} corners"
            raise InvalidFile(Problem("the mesh", found, "3 or more"))
        wrong = (self._corners < 0) | (self._corners >= vertices)
        if wrong.any():
            found = f"has a corner at vertex {self._corners[wrong.argmax()]:,}"
            raise InvalidFile(Problem("the mesh", found, f"0 to {vertices - 1:,}"))
        starts = np.cumsum(self._counts) - self._counts
        return self._corners[fan(starts, self._counts)].astype(np.uint32)


def _binary_rows(element: wire.Element, body: npt.NDArray[np.uint8], order: str) -> tuple[Any, npt.NDArray[np.uint8]]:
    """Return the rows of an element, and the bytes after them."""
    if not element.lists:
        dtype = np.dtype([(name, order + kind) for name, kind in element.numbers])
        _require_rows(element, element.rows * dtype.itemsize <= len(body), len(body))
        memory.hold("the mesh", _VERTEX * element.rows)
        rows = np.frombuffer(body, dtype, element.rows) if dtype.itemsize else np.empty(element.rows)
        return rows, body[element.rows * dtype.itemsize :]
    wanted = _list_of(element)
    least = sum(np.dtype(each.counts or each.kind).itemsize for each in element.properties)
    _require_rows(element, element.rows * least <= len(body), len(body))
    memory.hold("the mesh", _CORNER * element.rows)
    if any((each.counts or "u")[0] == "f" for each in element.properties):
        raise InvalidFile(Problem(f"element {element.name[:40]}", "has lists of a fractional length", _ALLOWED))
    if (alike := _alike(element, body, order, wanted)) is not None:
        return alike
    from nerfbake.kernels.surface.polygons import find_lists  # imports numba, which most files do not need

    steps = np.array(
        [
            (np.dtype(each.kind).itemsize, np.dtype(each.counts).itemsize, each.counts[0] == "i")
            if each.counts
            else (np.dtype(each.kind).itemsize, 0, 0)
            for each in element.properties
        ],
        np.int64,
    )
    try:
        starts, counts = find_lists(body, element.rows, steps, wanted, swapped=order == ">")
        last = find_lists(body, element.rows, steps, len(steps) - 1, swapped=order == ">")
    except ValueError:
        raise InvalidFile(Problem(f"element {element.name[:40]}", "does not end within the file", _ALLOWED)) from None
    end = int(last[0][-1] + last[1][-1] * steps[-1, 0]) if element.rows else 0
    kind = np.dtype(order + element.properties[wanted].kind)
    memory.hold("the mesh", (_CORNER + _TRIANGLE) * int(counts.sum()))
    each = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    places = np.repeat(starts, counts) + each * kind.itemsize
    octets = np.empty((0, kind.itemsize), np.uint8)
    if len(places):
        octets = np.lib.stride_tricks.sliding_window_view(body, kind.itemsize)[places]
    with np.errstate(invalid="ignore"):
        corners = np.ascontiguousarray(octets).view(kind).reshape(-1).astype(np.int64)
    return _Polygons(corners, counts), body[end:]


def _alike(
    element: wire.Element, body: npt.NDArray[np.uint8], order: str, wanted: int
) -> tuple[_Polygons, npt.NDArray[np.uint8]] | None:
    """_binary_rows() if lists have the same lengths in all rows, as in a mesh of triangles, else None."""
    if not element.rows:
        return None
    fields: list[Any] = []
    at = 0
    for k, each in enumerate(element.properties):
        count = 1
        if each.counts:
            length = np.dtype(order + each.counts)
            fields.append((f"count {k}", length))
            if at + length.itemsize > len(body):
                return None
            count, at = int(np.frombuffer(body, length, 1, at)[0]), at + length.itemsize
        at += count * np.dtype(each.kind).itemsize
        if count < 0 or at > len(body):
            return None
        fields.append((f"list {k}", order + each.kind, (count,)))
    if element.rows * at > len(body):
        return None
    rows = np.frombuffer(body, np.dtype(fields), element.rows)
    lengths = [name for name, *_ in fields if name.startswith("count")]
    if any((rows[name] != rows[name][0]).any() for name in lengths):
        return None
    memory.hold("the mesh", _TRIANGLE * rows[f"list {wanted}"].size)
    with np.errstate(invalid="ignore"):
        corners = rows[f"list {wanted}"].astype(np.int64)
    return _Polygons(corners.reshape(-1), np.full(element.rows, corners.shape[1])), body[element.rows * at :]


def _text_rows(element: wire.Element, body: npt.NDArray[np.float64], _: str) -> tuple[Any, npt.NDArray[np.float64]]:
    """Return the rows of an element, and the numbers after them."""
    columns = len(element.properties)
    if not element.lists:
        size = element.rows * columns
        _require_rows(element, size <= len(body), len(body))
        memory.hold("the mesh", _VERTEX * element.rows)
        table = body[:size].reshape(element.rows, columns)
        return {each.name: table[:, k] for k, each in enumerate(element.properties)}, body[size:]
    wanted = _list_of(element)
    _require_rows(element, element.rows * columns <= len(body), len(body))
    memory.hold("the mesh", (_CORNER + 40) * len(body))
    lists, at = [], 0
    for _row in range(element.rows):
        for k, each in enumerate(element.properties):
            count = 1
            if each.counts is not None:
                length = body[at] if at < len(body) else -1.0
                if not 0 <= length <= len(body):
                    raise InvalidFile(Problem("element face", "does not end within the file", _ALLOWED))
                count, at = int(length), at + 1
            if k == wanted:
                lists.append(body[at : at + count])
            at += count
    _require_rows(element, at <= len(body), len(body))
    counts = np.array([len(each) for each in lists], np.int64)
    corners = np.concatenate(lists) if lists else np.empty(0)
    whole = np.where(np.isfinite(corners) & (np.abs(corners) < 2**53), corners, -1)
    return _Polygons(whole.astype(np.int64), counts), body[at:]


def _list_of(element: wire.Element) -> int:
    """Return the index of the list of an element's corners; of another element's first list."""
    names = [each.name if each.counts else "" for each in element.properties]
    wanted = next((names.index(name) for name in _INDICES if name in names), None)
    if element.name == "face" and wanted is None:
        raise InvalidFile(Problem("element face", "has no list vertex_indices", _ALLOWED))
    return next(k for k, name in enumerate(names) if name) if wanted is None else wanted


def _require_rows(element: wire.Element, fits: bool, left: int) -> None:
    if not fits:
        found = f"declares {element.rows:,} rows, with {left:,} bytes or numbers left"
        raise InvalidFile(Problem(f"element {element.name[:40]}", found, _ALLOWED))


def _has(rows: Any, name: str) -> bool:
    return name in (rows if isinstance(rows, dict) else getattr(rows, "dtype", np.dtype("u1")).names or ())


def _columns(rows: Any, names: tuple[str, ...]) -> npt.NDArray[np.float64]:
    for name in names:
        if not _has(rows, name):
            raise InvalidFile(Problem("element vertex", f"has no property {name}", ", ".join(names)))
    with np.errstate(invalid="ignore"):
        return np.stack([np.asarray(rows[name], np.float64) for name in names], axis=1)


def _colours(rows: Any, header: wire.Header) -> npt.NDArray[np.float32] | None:
    if not all(_has(rows, name) for name in _RGB):
        return None
    kinds = dict(next(each for each in header.elements if each.name == "vertex").numbers)
    white = [1 if kinds[name][0] == "f" else 65_535 if kinds[name] == "u2" else 255 for name in _RGB]
    return (_columns(rows, _RGB) / white).astype(np.float32)


def encode(scene: Meshes) -> Iterator[bytes]:
    """Encode meshes as one. Raises InvalidScene for textures and levels of detail.

    Texture coordinates are left out. Where some meshes have colours, the others are grey.
    """
    if any(mesh.texture is not None for mesh in scene.meshes):
        raise InvalidScene(Problem("the mesh", "has a texture", "vertex colours, or .glb"))
    if scene.coarser:
        raise InvalidScene(Problem("the mesh", f"has {1 + len(scene.coarser)} levels of detail", "one, or .glb"))
    coloured = any(mesh.colours is not None for mesh in scene.meshes)
    vertices, triangles = (
        sum(map(len, each)) for each in zip(*((m.positions, m.faces) for m in scene.meshes), strict=True)
    )
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    columns += "".join(f"property uchar {name}\n" for name in _RGB if coloured)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{columns}"
    yield (head + f"element face {triangles}\nproperty list uchar int vertex_indices\nend_header\n").encode()
    for mesh in scene.meshes:
        rows = np.empty(
            len(mesh.positions), [("place", "<f4", 3), ("colour", "u1", 3)] if coloured else [("place", "<f4", 3)]
        )
        rows["place"] = mesh.positions
        if coloured:
            rows["colour"] = np.rint(255 * (_GREY if mesh.colours is None else mesh.colours))
        yield rows.tobytes()
    first = 0
    for mesh in scene.meshes:
        faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, mesh.faces.astype(np.int64) + first
        first += len(mesh.positions)
        yield faces.tobytes()
