r"""Read and write meshes as .ply: positions, vertex colours, polygons.

    ply\n format binary_little_endian 1.0\n
    element vertex V\n property float x\n ... y\n ... z\n property uchar red\n ... green\n ... blue\n
    element face T\n property list uchar int vertex_indices\n end_header\n
    V rows of 3 f32 (and 3 u8) | T rows of u8 3, 3 i32

Colours are sRGB; their type decides whether they go to 1 (float), 65,535 (ushort) or 255 (other integers). The reader
takes text and both byte orders, other properties in any order, and polygons of any size. Textures and colours of faces
are left out with a note. Files with f_dc_0 or packed_position are splats, which splat/ply.py reads, as are files
without faces.

It also reads, with a note, rows that are longer than the header declares, lines of the header that start with no word
of the format, and polygons of one or two corners, which it skips. Instead of `face`, a file may have `tristrips`: lists
of vertices of which every three in a row are a triangle, every second one reversed; -1 starts the next strip.

Source: formats/wire/ply.py; for tristrips trimesh2 (Rusinkiewicz) and the Stanford 3D Scanning Repository.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.mesh.colours import GREY, are_bytes_in_shorts, sound_colours
from nerfbake.formats.mesh.ply_text import LONGER, TextRows, parse_text
from nerfbake.formats.wire import ply as wire
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.surface.fans import fan
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.origin import choose_origin, relative_to

_ALLOWED = "a whole .ply of polygons"
_VERTEX = 60  # and per vertex
_CORNER = 60  # and per corner of a polygon
_TRIANGLE = 40  # and per corner while its polygon becomes triangles
_INDICES = ("vertex_indices", "vertex_index")
_TOLD = 60  # characters of a name in a note
_RGB = ("red", "green", "blue")
_COLOURS = (_RGB, ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))  # as programs name them
_FACES = ("face", "tristrips")
_SPLATS = ("f_dc_0", "scalar_f_dc_0")  # as in splat/ply.py


def recognise(view: memoryview) -> bool:
    """Return True for a header with faces, and without the properties of splats."""
    try:
        header = wire.parse_header(view)
    except InvalidFile:
        return False
    vertex = header.element("vertex")
    names = [each.name for each in vertex.properties] if vertex else []
    splats = any(name in _SPLATS or name.startswith("packed_") for name in names)
    return not splats and any(header.element(name) for name in _FACES)


def decode(view: memoryview) -> Meshes:
    """Parse a mesh. Raises InvalidFile, InvalidScene for invalid mesh values, MemoryLimit."""
    header = wire.parse_header(view)
    notes: dict[str, None] = {}
    if header.unknown:
        notes[f"the line {header.unknown[0].strip()[:_TOLD]!r} of the header is skipped"] = None
    vertices, faces = _tables(view, header, notes)
    positions = _columns(vertices, ("x", "y", "z"))
    colours = _colours(vertices, header, notes)
    triangles = faces.triangles(len(positions), notes)
    if not np.isfinite(positions).all():  # as in scans, for pixels without depth
        used, corners = np.unique(triangles, return_inverse=True)
        triangles = corners.reshape(-1, 3).astype(np.uint32)
        positions, colours = positions[used], None if colours is None else colours[used]
    origin = choose_origin([positions])
    mesh = Mesh(relative_to(positions, origin), None, triangles, colours=colours)
    return Meshes((mesh,), notes=(*notes, *_notes(header, colours is None)), origin=origin)


def _tables(view: memoryview, header: wire.Header, notes: dict[str, None]) -> tuple[Any, _Polygons]:
    """Return the rows of the vertices, and the polygons."""
    wanted = {"vertex", next((name for name in _FACES if header.element(name)), "face")}
    names = [element.name for element in header.elements]
    if missing := sorted(wanted.difference(names), reverse=True):
        raise InvalidFile(Problem("the mesh", f"has no element {missing[0]}", _ALLOWED))
    end = 1 + max(names.index(name) for name in wanted)
    elements, later = header.elements[:end], header.elements[end:]
    lists = [_list_of(element) for element in elements]
    body = view[header.end :]
    tables: dict[str, Any] = {}
    vertices = header.elements[names.index("vertex")].rows
    if header.kind == wire.TEXT:
        after = sum(element.rows * len(element.properties) for element in later)
        rows, more = parse_text(body, elements, lists, after)
        notes |= dict.fromkeys(more)
        tables = {each.name: _text_rows(each, found) for each, found in zip(elements, rows, strict=True)}
    else:
        octets = np.frombuffer(body, np.uint8)
        for number, (element, chosen) in enumerate(zip(elements, lists, strict=True)):
            order = wire.ORDERS[header.kind]
            if number + 1 == len(header.elements) and element.name == "face":
                tables["face"], octets = _last_rows(element, octets, order, chosen, vertices)
            else:
                tables[element.name], octets = _binary_rows(element, octets, order, chosen)
    faces = tables[(wanted - {"vertex"}).pop()]
    if not isinstance(faces, _Polygons):
        raise InvalidFile(Problem("element face", "has no list vertex_indices", _ALLOWED))
    if faces.longer:
        notes[LONGER] = None
    return tables["vertex"], faces if "face" in wanted else faces.of_strips()


def _notes(header: wire.Header, grey: bool) -> Iterator[str]:
    """Yield a line for a texture, and one for colours of faces if the vertices have none."""
    words = (comment.partition(" ") for comment in header.comments)
    if pictures := [name for word, _, name in words if word == "TextureFile"]:
        yield f"texture {pictures[0][:_TOLD]!r} is not read from a .ply, but from a .glb or .obj"
    faces = header.element("face")
    if grey and faces and {*_RGB} <= {each.name for each in faces.properties}:
        yield "colours of faces are not read, but colours of vertices"


class _Polygons:
    """The corners of all polygons, one after the other, and the number of corners of each.

    longer: the rows of the file are longer than declared.
    """

    def __init__(self, corners: Ints, counts: Ints, *, longer: bool = False) -> None:
        self._corners, self._counts, self.longer = corners, counts, longer

    def fit(self, vertices: int) -> bool:
        """Whether all corners are vertices, and all polygons have three or more."""
        if not len(self._corners) or self._counts.min() < 3:
            return False
        return bool(self._corners.min() >= 0 and self._corners.max() < vertices)

    def of_strips(self) -> _Polygons:
        """Return the triangles, if these are strips. Triangles without an area, which join strips, are left out."""
        index = np.arange(len(self._corners))
        cut = self._corners == -1
        begin = np.where(cut, index + 1, 0)
        firsts = np.cumsum(self._counts) - self._counts
        begin[firsts[self._counts > 0]] = firsts[self._counts > 0]
        begin = np.maximum.accumulate(begin)  # where the strip of each corner begins
        whole = (begin[2:] <= index[:-2]) & ~cut[2:]
        first = index[:-2][whole]
        odd = (first - begin[first]) % 2
        triangles = self._corners[np.stack([first + odd, first + 1 - odd, first + 2], axis=1)]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (a != c)]
        return _Polygons(triangles.reshape(-1), np.full(len(triangles), 3))

    def triangles(self, vertices: int, notes: dict[str, None]) -> npt.NDArray[np.uint32]:
        """Return the triangles, (t, 3). Polygons of fewer than three corners are skipped with a note."""
        corners, counts = self._corners, self._counts
        if (short := counts < 3).any():
            notes[f"faces of fewer than three corners are skipped ({int(short.sum()):,})"] = None
            corners, counts = corners[np.repeat(~short, counts)], counts[~short]
        if not len(counts):
            raise InvalidFile(Problem("the mesh", "has no faces", "at least one triangle"))
        wrong = (corners < 0) | (corners >= vertices)
        if wrong.any():
            found = f"has a corner at vertex {corners[wrong.argmax()]:,}"
            raise InvalidFile(Problem("the mesh", found, f"0 to {vertices - 1:,}"))
        return corners[fan(np.cumsum(counts) - counts, counts)].astype(np.uint32)


def _last_rows(
    element: wire.Element, body: npt.NDArray[np.uint8], order: str, wanted: int, vertices: int
) -> tuple[Any, npt.NDArray[np.uint8]]:
    """_binary_rows() of the last element. If its rows make no mesh as declared, they may be longer and fill the file.

    VCGLIB declares four numbers of a colour where it writes a list of nine, for example.
    """
    problem = polygons = None
    try:
        polygons, rest = _binary_rows(element, body, order, wanted)
        if not len(rest) or polygons.fit(vertices):
            return polygons, rest
    except InvalidFile as error:
        problem = error
    if 0 < element.rows <= len(body) and len(body) % element.rows == 0:
        alike = _alike(element, body, order, wanted, len(body) // element.rows)
        if alike is not None and alike[0].fit(vertices):
            return alike
    if problem is not None:
        raise problem
    return polygons, rest


def _binary_rows(
    element: wire.Element, body: npt.NDArray[np.uint8], order: str, wanted: int
) -> tuple[Any, npt.NDArray[np.uint8]]:
    """Return the rows of an element, and the bytes after them."""
    if not element.lists:
        dtype = np.dtype([(name, order + kind) for name, kind in element.numbers])
        _require_rows(element, element.rows * dtype.itemsize <= len(body), len(body))
        memory.hold("the mesh", _VERTEX * element.rows)
        rows = np.frombuffer(body, dtype, element.rows) if dtype.itemsize else np.empty(element.rows)
        return rows, body[element.rows * dtype.itemsize :]
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
    element: wire.Element, body: npt.NDArray[np.uint8], order: str, wanted: int, stride: int = 0
) -> tuple[_Polygons, npt.NDArray[np.uint8]] | None:
    """_binary_rows() if lists have the same lengths in all rows, as in a mesh of triangles, else None.

    stride: bytes of a row that is longer than its properties; 0 for rows as declared
    """
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
    if stride:
        if stride <= at:
            return None
        fields.append(("more", f"V{stride - at}"))
        at = stride
    if element.rows * at > len(body) or at >= 1 << 31:  # NumPy's limit of a row
        return None
    rows = np.frombuffer(body, np.dtype(fields), element.rows)
    lengths = [name for name, *_ in fields if name.startswith("count")]
    if any((rows[name] != rows[name][0]).any() for name in lengths):
        return None
    memory.hold("the mesh", _TRIANGLE * rows[f"list {wanted}"].size)
    with np.errstate(invalid="ignore"):
        corners = rows[f"list {wanted}"].astype(np.int64)
    counts = np.full(element.rows, corners.shape[1])
    return _Polygons(corners.reshape(-1), counts, longer=stride > 0), body[element.rows * at :]


def _text_rows(element: wire.Element, rows: TextRows) -> Any:
    """Return the columns of an element by name, or the polygons of its list."""
    if element.name == "vertex":
        memory.hold("the mesh", _VERTEX * element.rows)
        return rows.columns
    memory.hold("the mesh", _CORNER * len(rows.entries))
    sound = np.isfinite(rows.entries) & (np.abs(rows.entries) < 2**53)
    return _Polygons(np.where(sound, rows.entries, -1).astype(np.int64), rows.counts) if element.lists else None


def _list_of(element: wire.Element) -> int:
    """Return the index of the list of an element's corners; of another element's first list; -1 if it has no lists."""
    names = [each.name if each.counts else "" for each in element.properties]
    wanted = next((names.index(name) for name in _INDICES if name in names), -1)
    if element.name in _FACES and wanted < 0:
        raise InvalidFile(Problem(f"element {element.name}", "has no list vertex_indices", _ALLOWED))
    return next((k for k, name in enumerate(names) if name), -1) if wanted < 0 else wanted


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


def _colours(rows: Any, header: wire.Header, notes: dict[str, None]) -> npt.NDArray[np.float32] | None:
    names = next((names for names in _COLOURS if all(_has(rows, name) for name in names)), None)
    if names is None:
        return None
    kinds = dict(next(each for each in header.elements if each.name == "vertex").numbers)
    white = [1 if kinds[name][0] == "f" else 65_535 if kinds[name] == "u2" else 255 for name in names]
    values = _columns(rows, names)
    if white == [65_535] * 3 and are_bytes_in_shorts(values):
        white = [255] * 3
        notes["colours of 16 bits go to 255 only, and are read as those of 8 bits"] = None
    colours, more = sound_colours(values / white, scaled=white != [1] * 3)
    notes |= dict.fromkeys(more)
    return colours.astype(np.float32)


def encode(scene: Meshes) -> Iterator[bytes]:
    """Encode meshes as one. Raises InvalidScene for textures and levels of detail.

    Texture coordinates are left out. Where some meshes have colours, the others are grey. x y z are doubles if the
    meshes have an origin.
    """
    if any(mesh.texture is not None for mesh in scene.meshes):
        raise InvalidScene(Problem("the mesh", "has a texture", "vertex colours, or .glb"))
    if scene.coarser:
        raise InvalidScene(Problem("the mesh", f"has {1 + len(scene.coarser)} levels of detail", "one, or .glb"))
    coloured = any(mesh.colours is not None for mesh in scene.meshes)
    vertices, triangles = (
        sum(map(len, each)) for each in zip(*((m.positions, m.faces) for m in scene.meshes), strict=True)
    )
    far = bool(scene.origin.any())
    columns = "".join(f"property {'double' if far else 'float'} {axis}\n" for axis in "xyz")
    columns += "".join(f"property uchar {name}\n" for name in _RGB if coloured)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{columns}"
    yield (head + f"element face {triangles}\nproperty list uchar int vertex_indices\nend_header\n").encode()
    for mesh in scene.meshes:
        place = ("place", "<f8" if far else "<f4", 3)
        rows = np.empty(len(mesh.positions), [place, ("colour", "u1", 3)] if coloured else [place])
        rows["place"] = mesh.positions + scene.origin if far else mesh.positions
        if coloured:
            rows["colour"] = np.rint(255 * (GREY if mesh.colours is None else mesh.colours))
        yield rows.tobytes()
    first = 0
    for mesh in scene.meshes:
        faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, mesh.faces.astype(np.int64) + first
        first += len(mesh.positions)
        yield faces.tobytes()
