r"""Read and write meshes as Wavefront text (.obj): positions, texture coordinates, vertex colours, faces.

    v x y z [w] [r g b]     vt u v     usemtl NAME     f v[/vt[/vn]] v[/vt[/vn]] v[/vt[/vn]] ...

Indices start at 1 and count through the whole file. Negative indices count back from their line: -1 is the last entry
before it. w is ignored. A \ at the end of a line joins it with the next line. # starts a comment at the start of a line
and after numbers, but names may contain it. All other statements are ignored. The parser works on whole columns at a
time.

Coordinates are those of the field. Materials and textures stand in files beside the .obj: `mtllib NAME ...` names the
libraries, see mtl.py. A textured mesh is written as three files, because other programs look for them there: NAME.obj,
NAME.mtl and NAME.png. A mesh without texture is one file.
"""

from __future__ import annotations

import io
import re
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.mesh.mtl import Materials, encode_mtl
from nerfbake.formats.wire.picture import encode_picture
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.soundness import plural
from nerfbake.kernels.surface.fans import fan
from nerfbake.scene.mesh import Mesh, Meshes, require_few, rounding_notes

_PER_BYTE = 8  # bytes of memory per byte of text while it is parsed
_PER_CORNER = 200  # and per corner of a polygon; two bytes of text may be one corner
_ALLOWED = "a whole .obj of polygons"
_NAMES = {b"v": "vertex", b"vt": "texture coordinate", b"f": "face"}  # of lines, in errors
_NUMBER = rb"[-+]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++|nan|inf)(?:e[-+]?[0-9]++)?"
_NUMBERS = re.compile(rb"\s*+(?:" + _NUMBER + rb"(?:\s++|$))*+", re.IGNORECASE)
_INDEX = rb"-?[0-9]{1,18}+"
_CORNERS = re.compile(rb"\s*+(?:%b(?:/(?:%b)?(?:/(?:%b)?)?)?(?:\s++|$))*+" % (_INDEX, _INDEX, _INDEX))

Bytes = npt.NDArray[np.uint8]


def decode_obj(view: memoryview, name: str, beside: Mapping[str, memoryview] | None = None) -> Meshes:
    """Parse the meshes, one for each material. Polygons become triangle fans. beside: the files of the same folder.

    Vertices with several texture coordinates are split, and unused vertices are dropped. Colours are used only if every
    vertex has one, texture coordinates only if every corner of a mesh has one. Notes tell which libraries and pictures
    are not read. Raises InvalidFile, InvalidScene for invalid mesh values, MemoryLimit.
    """
    with memory.lent(name, _PER_BYTE * len(view)):
        text = _Text(view, name)
        points, colours = text.vertices()
        places = text.places()
        corners = text.corners(len(points), len(places))
        order = np.argsort(corners.material, kind="stable")
        ends = np.flatnonzero(np.diff(corners.material[order], append=-1)) + 1
        require_few(len(ends))
        parts = np.split(order, ends[:-1])
        known, materials = text.material_names(), Materials(text.libraries(), beside)
        found = []
        for part in sorted(parts, key=lambda part: part[0]):  # in the order in which materials first occur in the file
            mesh = _mesh(corners, part, points, colours, places)
            texture = materials.texture(known[corners.material[part[0]]], placed=mesh.uvs is not None)
            found.append(mesh if texture is None else replace(mesh, texture=texture))
        return Meshes(tuple(found), notes=(*materials.notes, *rounding_notes(points)))


class _Corners(NamedTuple):
    """Indices for each triangle: vertices (t, 3), texture coordinates (t, 3) or -1 for none, material (t,)."""

    vertex: Ints
    place: Ints
    material: Ints


class _Numbers(NamedTuple):
    """The concatenated numbers of all lines that start with a word, and the count of each line, (lines,)."""

    word: bytes
    values: Floats
    counts: Ints


def _mesh(corners: _Corners, part: Ints, points: Floats, colours: Floats | None, places: Floats) -> Mesh:
    vertex, place = corners.vertex[part].reshape(-1), corners.place[part].reshape(-1)
    if (place < 0).any():
        used, faces = np.unique(vertex, return_inverse=True)
        uvs = None
    else:
        pairs, faces = np.unique(vertex * len(places) + place, return_inverse=True)
        used, uvs = pairs // len(places), places[pairs % len(places)] * [1, -1] + [0, 1]  # v counts from the bottom
    with np.errstate(over="ignore"):  # overflow becomes infinite, which Mesh rejects
        return Mesh(
            points[used].astype(np.float32),
            None if uvs is None else uvs.astype(np.float32),
            faces.reshape(-1, 3).astype(np.uint32),
            colours=None if colours is None else colours[used].astype(np.float32),
        )


class _Text:
    """The bytes of the file, with an index of its lines."""

    def __init__(self, view: memoryview, name: str) -> None:
        self._name = name
        whole = bytes(view).removeprefix(BOM_UTF8).replace(b"\\\r\n", b"  ").replace(b"\\\n", b" ")
        # Normalise the text: every line starts with its first word, and the last one is followed by other bytes.
        self._bytes = np.frombuffer(re.sub(rb"\n[ \t\r\n]++", b"\n", b"\n" + whole + b"\n") + bytes(8), np.uint8)
        breaks = np.flatnonzero(self._bytes == ord("\n"))
        self._starts, self._ends = breaks[:-1] + 1, breaks[1:]

    def lines(self, word: bytes) -> Ints:
        """Return the indices of the lines that start with this word."""
        found: npt.NDArray[np.bool_] = self._bytes[self._starts + len(word)] <= ord(" ")
        for k, letter in enumerate(word):
            found &= self._bytes[self._starts + k] == letter
        return np.flatnonzero(found & (self._ends - self._starts > len(word)))

    def numbers(self, word: bytes) -> _Numbers:
        """Parse the numbers after this word on each of its lines. Raises InvalidFile."""
        lines = self.lines(word)
        text = self._behind_words(lines)
        if not (match := _NUMBERS.match(text)) or match.end() < len(text):
            self._refuse(word, text, match.end() if match else 0)
        starts, line = _tokens(text)
        values = np.fromstring(text.decode("ascii"), np.float64, sep=" ")
        if len(values) != len(starts):
            found = f"it has {len(starts):,} words, of which only {len(values):,} are numbers"
            raise self._fault(found, _ALLOWED)
        return _Numbers(word, values, np.bincount(line, minlength=len(lines)))

    def columns(self, numbers: _Numbers, first: int, end: int, skipped: Ints | int = 0) -> Floats:
        """Return columns first to end of the numbers, (lines, end - first). Raises InvalidFile for shorter lines.

        skipped: how many columns further right they are, on each line.
        """
        word, values, counts = numbers
        if (counts < end).any():
            short = int((counts < end).argmax())
            raise self._fault(
                f"{_NAMES[word]} {short + 1:,} has {plural(int(counts[short]), 'number')}", f"{end} or more"
            )
        begin = np.cumsum(counts) - counts + skipped
        return np.asarray(values[begin[:, None] + np.arange(first, end)], np.float64)

    def vertices(self) -> tuple[Floats, Floats | None]:
        """Return positions (v, 3), and colours (v, 3) if all vertices have one."""
        found = self.numbers(b"v")
        coloured = len(found.counts) and (found.counts >= 6).all()
        weighted = (found.counts == 7).astype(np.int64)  # x y z w r g b
        return self.columns(found, 0, 3), self.columns(found, 3, 6, weighted) if coloured else None

    def places(self) -> Floats:
        """Return the texture coordinates, (p, 2). A line may leave out v, which is then 0."""
        found = self.numbers(b"vt")
        short = found.counts == 1
        if short.any():
            values = np.insert(found.values, np.cumsum(found.counts)[short], 0.0)
            found = found._replace(values=values, counts=found.counts + short)
        return self.columns(found, 0, 2)

    def corners(self, vertices: int, places: int) -> _Corners:
        """Parse all faces as triangles. Raises InvalidFile for invalid polygons and indices."""
        lines = self.lines(b"f")
        if not len(lines):
            raise InvalidFile(Problem(self._name, "has no faces", "at least one triangle"))
        text = self._behind_words(lines)
        if not (match := _CORNERS.match(text)) or match.end() < len(text):
            self._refuse(b"f", text, match.end() if match else 0)
        starts, line = _tokens(text)
        memory.hold(self._name, _PER_CORNER * len(starts))
        counts = np.bincount(line, minlength=len(lines))
        if (counts < 3).any():
            short = int((counts < 3).argmax())
            raise self._fault(f"face {short + 1:,} has {plural(int(counts[short]), 'corner')}", "3 or more")
        split = np.frombuffer(text, np.uint8)
        slashes = np.cumsum(split == ord("/"), dtype=np.int32)
        widths = np.diff(np.concatenate([[0], starts[1:], [len(split)]]))
        slashes -= np.repeat(slashes[starts], widths)  # a corner starts with a digit or a sign
        vertex = self._indices(split, slashes, 0, starts, line, lines, b"v", vertices)
        place = self._indices(split, slashes, 1, starts, line, lines, b"vt", places)
        polygon = np.repeat(np.arange(len(counts)), counts - 2)
        corner = fan(np.cumsum(counts) - counts, counts)
        return _Corners(vertex[corner], place[corner], self._materials(lines)[polygon])

    def _indices(
        self,
        text: Bytes,
        slashes: npt.NDArray[np.int32],
        part: int,
        starts: Ints,
        line: Ints,
        lines: Ints,
        word: bytes,
        count: int,
    ) -> Ints:
        """Parse one index of each corner, (corners,), from 0; -1 if a corner does not have it."""
        chosen = (slashes == part) & (text > ord(" ")) & (text != ord("/"))
        have = np.logical_or.reduceat(chosen, starts)
        digits = np.where(chosen, text, np.uint8(ord(" "))).tobytes().decode("ascii")
        numbers = np.fromstring(digits, np.int64, sep=" ")
        before = np.searchsorted(self.lines(word), lines[line[have]])
        index = np.where(numbers < 0, before + numbers, numbers - 1)
        wrong = (index < 0) | (index >= count)
        if wrong.any():
            first = int(wrong.argmax())
            told = f"face {line[have][first] + 1:,} has the {word.decode()} index {numbers[first]}"
            raise self._fault(told, f"1 to {count:,}, or -1 and below")
        found = np.full(len(starts), -1, np.int64)
        found[have] = index
        return found

    def libraries(self) -> Iterator[bytes]:
        """Yield what each mtllib line names: one library of materials or several."""
        return self._rests(b"mtllib")

    def material_names(self) -> list[bytes]:
        """Return the names of the materials in the order of their numbers. The first is used before any is named."""
        return [b"", *dict.fromkeys(self._rests(b"usemtl"))]

    def _rests(self, word: bytes) -> Iterator[bytes]:
        """Yield what follows this word on each of its lines."""
        lines = self.lines(word)
        places = zip(self._starts[lines] + len(word), self._ends[lines], strict=True)
        return (self._bytes[start:end].tobytes().strip() for start, end in places)

    def _materials(self, lines: Ints) -> Ints:
        """Return the material number of each of these lines, (faces,)."""
        numbers = {name: number for number, name in enumerate(self.material_names()[1:], 1)}
        named = [numbers[name] for name in self._rests(b"usemtl")]
        return np.array([0, *named])[np.searchsorted(self.lines(b"usemtl"), lines)]

    def _behind_words(self, lines: Ints) -> bytes:
        """Return these lines without their first word and their comment, each with its line break."""
        wanted = np.zeros(len(self._starts), bool)
        wanted[lines] = True
        mask = np.repeat(wanted, self._ends - self._starts + 1)
        mask[self._starts[lines] - 1] = False
        mask[self._starts[lines][self._bytes[self._starts[lines] + 1] > ord(" ")]] = False
        text = bytes(self._bytes[1 : 1 + len(mask)][mask].data)
        return re.sub(rb"#[^\n]*+", b"", text) if b"#" in text else text

    def _refuse(self, word: bytes, text: bytes, at: int) -> None:
        """Raise for what stands at this offset of the text behind the words."""
        found, number = text[at : at + 40].split()[0].decode("latin-1"), text.count(b"\n", 0, at) + 1
        raise self._fault(f"{_NAMES[word]} {number:,} has {found!r}", _ALLOWED)

    def _fault(self, found: str, allowed: str) -> InvalidFile:
        return InvalidFile(Problem(self._name, f"cannot be read: {found}", allowed))


def _tokens(text: bytes) -> tuple[Ints, Ints]:
    """Return the start of each word, and the line that contains it."""
    bytes_ = np.frombuffer(text, np.uint8)
    solid = bytes_ > ord(" ")
    starts = np.flatnonzero(solid & ~np.concatenate([[False], solid[:-1]])) if len(solid) else np.empty(0, np.int64)
    return starts, np.searchsorted(np.flatnonzero(bytes_ == ord("\n")), starts)


def encode_obj(meshes: Sequence[Mesh], library: str | None = None, materials: Sequence[str] = ()) -> Iterator[bytes]:
    """Yield the meshes as text. library: an .mtl file; materials: the name of each mesh's material in it."""
    if library:
        yield f"mtllib {library}\n".encode("utf-8", "surrogateescape")
    names = materials or ([f"mesh_{number}" for number in range(len(meshes))] if len(meshes) > 1 else [])
    vertex, corner = 1, 1  # both count from 1 through the whole file
    for number, mesh in enumerate(meshes):
        if names:
            yield f"usemtl {names[number]}\n".encode()
        points = mesh.positions if mesh.colours is None else np.concatenate([mesh.positions, mesh.colours], axis=1)
        yield _lines("v" + " %.7g" * points.shape[1], points)
        faces = mesh.faces.astype(np.int64)
        if mesh.uvs is None:
            yield _lines("f %d %d %d", faces + vertex)
        else:
            yield _lines("vt %.7g %.7g", np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1))
            both = np.stack([faces + vertex, faces + corner], axis=2).reshape(-1, 6)
            yield _lines("f %d/%d %d/%d %d/%d", both)
            corner += len(mesh.uvs)
        vertex += len(points)


def _lines(form: str, rows: npt.NDArray[Any]) -> bytes:
    text = io.BytesIO()
    np.savetxt(text, rows, fmt=form)
    return text.getvalue()


_KEYWORD = re.compile(rb"^(?:%b)?(v|vt|vn|mtllib|o|g|usemtl)[ \t]" % BOM_UTF8, re.MULTILINE)


def recognise(view: memoryview) -> bool:
    """Return True for text with one of the statements that .obj files start with."""
    head = bytes(view[:HEAD])
    return b"\0" not in head and _KEYWORD.search(head) is not None


def encode(scene: Meshes, *, image: Literal["png", "jpeg"] = "png") -> Iterator[bytes]:
    """Encode meshes without textures. Raises InvalidScene for textures, which encode_files() writes, and for levels.

    image: the coding of the textures.
    """
    if any(mesh.texture is not None for mesh in scene.meshes):
        raise InvalidScene(
            Problem("the mesh", "has a texture", "meshes without textures, .glb, or an .obj on the disk")
        )
    _require_one_level(scene)
    return encode_obj(scene.meshes)


def encode_files(
    scene: Meshes, stem: str, *, image: Literal["png", "jpeg"] = "png"
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the extension and the bytes of each file whose name is `stem` with an extension, the .obj first.

    A mesh without texture is an .obj alone. Raises InvalidScene for levels of detail.
    """
    _require_one_level(scene)
    textures = [mesh.texture for mesh in scene.meshes]
    if all(texture is None for texture in textures):
        yield ".obj", encode_obj(scene.meshes)
        return
    ending = {"png": ".png", "jpeg": ".jpg"}[image]
    pictures = [ending if len(textures) == 1 else f"_{number}{ending}" for number in range(len(textures))]
    names = [f"mesh_{number}" for number in range(len(textures))]
    yield ".obj", encode_obj(scene.meshes, f"{stem}.mtl", names)
    used = [None if each is None else stem + name for each, name in zip(textures, pictures, strict=True)]
    yield ".mtl", [encode_mtl(list(zip(names, used, strict=True)))]
    for texture, name in zip(textures, pictures, strict=True):
        if texture is not None:
            yield name, [encode_picture(texture, image)]


def _require_one_level(scene: Meshes) -> None:
    if scene.coarser:
        raise InvalidScene(Problem("the mesh", f"has {1 + len(scene.coarser)} levels of detail", "one, or .glb"))


def decode(view: memoryview, *, beside: Mapping[str, memoryview] | None = None) -> Meshes:
    """Parse meshes. Raises InvalidFile for invalid text or no faces, InvalidScene for invalid mesh values.

    beside: the files of the same folder, with materials and textures.
    """
    return decode_obj(view, "the mesh", beside)
