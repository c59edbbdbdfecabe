r"""Read and write meshes as Wavefront text (.obj): positions, texture coordinates, vertex colours, faces.

    v x y z [w] [r g b [a]]     vt u v     usemtl NAME     f v[/vt[/vn]] v[/vt[/vn]] v[/vt[/vn]] ...

Indices start at 1 and count through the whole file. Negative indices count back from their line: -1 is the last entry
before it. w and a are ignored. A \ at the end of a line joins it with the next line. # starts a comment at the start of
a line and after numbers, but names may contain it. All other statements are ignored. The parser works on whole columns
at a time.

ZBrush stores colours as comments, of up to 64 vertices a line: #MRGB and two hexadecimal digits each of a mask, red,
green and blue.

Coordinates are those of the field. Materials and textures stand in files beside the .obj: `mtllib NAME ...` names the
libraries, see mtl.py. A textured mesh is written as three files, because other programs look for them there: NAME.obj,
NAME.mtl and NAME.png. A mesh without texture is one file.
"""

from __future__ import annotations

import io
import re
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.mesh.colours import GREY, sound_colours
from nerfbake.formats.mesh.mtl import Materials, Texture, encode_mtl
from nerfbake.formats.mesh.words import words_of
from nerfbake.formats.wire.picture import encode_picture
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.soundness import plural
from nerfbake.kernels.surface.fans import fan
from nerfbake.scene.mesh import Mesh, Meshes, require_few
from nerfbake.scene.origin import choose_origin, no_origin, relative_to

_PER_BYTE = 8  # bytes of memory per byte of text while it is parsed
_PER_CORNER = 200  # and per corner of a polygon; two bytes of text may be one corner
_ALLOWED = "a whole .obj of polygons"
_WHITE = 1.0  # of vertices without a colour beside others, on a texture
_PAINT = b"#MRGB"
_NAMES = {b"v": "vertex", b"vt": "texture coordinate", b"f": "face"}  # of lines, in errors
_NUMBER = rb"[-+]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++|nan|inf)(?:e[-+]?[0-9]++)?"
_NUMBERS = re.compile(rb"\s*+(?:" + _NUMBER + rb"(?:\s++|$))*+", re.IGNORECASE)
_JOINED = re.compile(rb"\\[ \t\r]*+\n")
_NOT_NUMBERS = re.compile(rb"(?<=[ \t])-?(?:1\.#(?:IND|QNAN|SNAN)[0-9]*+|nan\([a-z]*+\))")  # as Windows prints them
_INDEX = rb"-?[0-9]{1,18}+"
_CORNERS = re.compile(rb"\s*+(?:%b(?:/(?:%b)?(?:/(?:%b)?)?)?(?:\s++|$))*+" % (_INDEX, _INDEX, _INDEX))

Bytes = npt.NDArray[np.uint8]


def decode_obj(view: memoryview, name: str, beside: Mapping[str, memoryview] | None = None) -> Meshes:
    """Parse the meshes, one for each material. Polygons become triangle fans. beside: the files of the same folder.

    Vertices with several texture coordinates are split, and unused vertices are dropped. Vertices without a colour are
    grey if others of their mesh have one, and white on a texture. Texture coordinates are used only if every corner of
    a mesh has one. Notes tell what is repaired or not read. Raises InvalidFile, InvalidScene for invalid mesh values,
    MemoryLimit.
    """
    with memory.lent(name, _PER_BYTE * len(view)):
        text = _Text(view, name)
        points, paint = text.vertices()
        origin = choose_origin([points])
        near = relative_to(points, origin)
        places = text.places()
        corners = text.corners(len(points), len(places))
        order = np.argsort(corners.material, kind="stable")
        ends = np.flatnonzero(np.diff(corners.material[order], append=-1)) + 1
        require_few(len(ends))
        parts = np.split(order, ends[:-1])
        known, materials = text.material_names(), Materials(text.libraries(), beside)
        found = []
        for part in sorted(parts, key=lambda part: part[0]):  # in the order in which materials first occur in the file
            placed = not (corners.place[part] < 0).any()
            texture = materials.texture(known[corners.material[part[0]]], placed=placed)
            found.append(_mesh(corners, part, near, paint, places if placed else None, texture))
        notes = dict.fromkeys((*materials.notes, *text.notes, *(paint.notes if paint else ())))
        return Meshes(tuple(found), notes=tuple(notes), origin=origin)


class _Paint:
    """Colours (v, 3) of vertices, of which some may have none: given, (v,) bool."""

    def __init__(self, colours: Floats, given: npt.NDArray[np.bool_], notes: list[str]) -> None:
        self._colours, self._given, self.notes = colours, given, notes

    def of(self, used: Ints, *, textured: bool) -> npt.NDArray[np.float32] | None:
        """Return the colours of these vertices; None if none of them has one."""
        given = self._given[used]
        if not given.any():
            return None
        colours = self._colours[used].astype(np.float32)
        if not given.all():
            colours[~given] = _WHITE if textured else GREY
            self.notes.append(f"vertices without a colour beside others are {'white' if textured else 'grey'}")
        return colours


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


def _mesh(
    corners: _Corners,
    part: Ints,
    points: npt.NDArray[np.float32],
    paint: _Paint | None,
    places: Floats | None,
    texture: Texture | tuple[None, None],
) -> Mesh:
    """Return the mesh of these triangles. places: None if it has no texture coordinates."""
    vertex, place = corners.vertex[part].reshape(-1), corners.place[part].reshape(-1)
    if places is None:
        used, faces = np.unique(vertex, return_inverse=True)
        uvs = None
    else:
        pairs, faces = np.unique(vertex * len(places) + place, return_inverse=True)
        used, uvs = pairs // len(places), places[pairs % len(places)] * [1, -1] + [0, 1]  # v counts from the bottom
    with np.errstate(over="ignore"):  # overflow becomes infinite, which Mesh rejects
        return Mesh(
            points[used],
            None if uvs is None else uvs.astype(np.float32),
            faces.reshape(-1, 3).astype(np.uint32),
            texture[0],
            None if paint is None else paint.of(used, textured=texture[0] is not None),
            opaque=texture[1],
        )


class _Text:
    """The bytes of the file, with an index of its lines."""

    def __init__(self, view: memoryview, name: str) -> None:
        self._name = name
        self.notes: list[str] = []  # what was repaired or skipped
        self._lines: dict[bytes, Ints] = {}  # by word, because most are asked for several times
        whole = bytes(view).removeprefix(BOM_UTF8)
        if b"\n" not in whole:
            whole = whole.replace(b"\r", b"\n")  # as the first Macintoshes ended lines
        if b"\\" in whole:
            whole = _JOINED.sub(b" ", whole)
        commented = b"#" in whole  # to look for one byte takes a tenth of the time
        if (commented and b"1.#" in whole) or (b"(" in whole and b"nan(" in whole):
            whole = _NOT_NUMBERS.sub(b"nan", whole)
        self._painted = commented and _PAINT in whole
        # Normalise the text: every line starts with its first word, and the last one is followed by other bytes.
        self._bytes = np.frombuffer(re.sub(rb"\n[ \t\r\n]++", b"\n", b"\n" + whole + b"\n") + bytes(8), np.uint8)
        breaks = np.flatnonzero(self._bytes == ord("\n"))
        self._starts, self._ends = breaks[:-1] + 1, breaks[1:]

    def lines(self, word: bytes) -> Ints:
        """Return the indices of the lines that start with this word."""
        if word in self._lines:
            return self._lines[word]
        found: npt.NDArray[np.bool_] = self._bytes[self._starts + len(word)] <= ord(" ")
        for k, letter in enumerate(word):
            found &= self._bytes[self._starts + k] == letter
        self._lines[word] = np.flatnonzero(found & (self._ends - self._starts > len(word)))
        return self._lines[word]

    def numbers(self, word: bytes) -> _Numbers:
        """Parse the numbers after this word on each of its lines. Raises InvalidFile."""
        lines = self.lines(word)
        text = self._behind_words(lines)
        if not (match := _NUMBERS.match(text)) or match.end() < len(text):
            self._refuse(word, text, match.end() if match else 0)
        starts, line = words_of(text)
        values = np.fromstring(text.decode("ascii"), np.float64, sep=" ")
        if len(values) != len(starts):
            found = f"it has {len(starts):,} words, of which only {len(values):,} are numbers"
            raise self._fault(found, _ALLOWED)
        return _Numbers(word, values, np.bincount(line, minlength=len(lines)))

    def columns(self, numbers: _Numbers, first: int, end: int) -> Floats:
        """Return columns first to end of the numbers, (lines, end - first). Raises InvalidFile for shorter lines."""
        word, values, counts = numbers
        if (counts < end).any():
            short = int((counts < end).argmax())
            raise self._fault(
                f"{_NAMES[word]} {short + 1:,} has {plural(int(counts[short]), 'number')}", f"{end} or more"
            )
        begin = np.cumsum(counts) - counts
        return np.asarray(values[begin[:, None] + np.arange(first, end)], np.float64)

    def vertices(self) -> tuple[Floats, _Paint | None]:
        """Return positions (v, 3), and their colours if any has one."""
        found = self.numbers(b"v")
        points, given = self.columns(found, 0, 3), found.counts >= 6
        if not given.any():
            return points, self._polypaint(len(points))
        first = np.cumsum(found.counts) - found.counts + 3
        first += self._weighted(found, first)
        colours = np.zeros_like(points)
        colours[given], notes = sound_colours(found.values[first[given, None] + np.arange(3)])
        return points, _Paint(colours, given, notes)

    def _weighted(self, found: _Numbers, first: Ints) -> npt.NDArray[np.bool_]:
        """Whether a weight precedes the colours, (lines,): x y z w r g b. Else opacity follows them: x y z r g b a.

        A weight is 1 everywhere while the last number is not, or it is beyond 0 to 1 while colours are within.
        """
        seven: npt.NDArray[np.bool_] = found.counts == 7
        if not seven.any():
            return seven
        w, a = found.values[first[seven]], found.values[first[seven] + 3]
        rest = found.values[first[seven, None] + np.arange(1, 4)]
        if (w == 1).all() and (a == 1).all():
            if not (rest == 1).all():  # else both are white
                self.notes.append("vertices with seven numbers are read as x y z, red, green, blue and opacity")
            return np.zeros(len(seven), bool)
        beyond = ((w < 0) | (w > 1)).any() and ((rest >= 0) & (rest <= 1)).all()
        return seven if (w == 1).all() or beyond else np.zeros(len(seven), bool)

    def _polypaint(self, count: int) -> _Paint | None:
        """Return the colours in ZBrush's comments; None if there are none."""
        text = b"".join(self._rests(_PAINT)) if self._painted else b""
        if not text:
            return None
        try:
            paint = np.frombuffer(bytes.fromhex(text.decode("ascii")), np.uint8)
        except ValueError:
            paint = np.empty(0, np.uint8)
        if len(paint) != 4 * count:
            self.notes.append(f"the colours of {_PAINT.decode()} are not read, because they do not fit the vertices")
            return None
        return _Paint(paint.reshape(-1, 4)[:, 1:] / np.float64(255), np.ones(count, bool), [])

    def places(self) -> Floats:
        """Return the texture coordinates, (p, 2). A line may leave out v, which is then 0."""
        found = self.numbers(b"vt")
        short = found.counts == 1
        if short.any():
            values = np.insert(found.values, np.cumsum(found.counts)[short], 0.0)
            found = found._replace(values=values, counts=found.counts + short)
        places = self.columns(found, 0, 2)
        if (wrong := np.isnan(places)).any():
            self.notes.append("texture coordinates that are not numbers are 0")
            places[wrong] = 0
        return places

    def corners(self, vertices: int, places: int) -> _Corners:
        """Parse all faces as triangles. Raises InvalidFile for invalid polygons and indices."""
        lines = self.lines(b"f")
        text, starts, line, counts = self._polygons(lines)
        if (short := counts < 3).any():
            self.notes.append(f"faces of fewer than three corners are skipped ({int(short.sum()):,})")
            lines = lines[~short]
            text, starts, line, counts = self._polygons(lines)
        if not len(lines):
            raise InvalidFile(Problem(self._name, "has no faces", "at least one triangle"))
        memory.hold(self._name, _PER_CORNER * len(starts))
        split = np.frombuffer(text, np.uint8)
        slashes = np.cumsum(split == ord("/"), dtype=np.int32)
        widths = np.diff(np.concatenate([[0], starts[1:], [len(split)]]))
        slashes -= np.repeat(slashes[starts], widths)  # a corner starts with a digit or a sign
        vertex = self._indices(split, slashes, 0, starts, line, lines, b"v", vertices)
        place = self._indices(split, slashes, 1, starts, line, lines, b"vt", places)
        polygon = np.repeat(np.arange(len(counts)), counts - 2)
        corner = fan(np.cumsum(counts) - counts, counts)
        return _Corners(vertex[corner], place[corner], self._materials(lines)[polygon])

    def _polygons(self, lines: Ints) -> tuple[bytes, Ints, Ints, Ints]:
        """Return the corners of these faces as text, the start and the line of each, and the corners of each face."""
        text = self._behind_words(lines)
        if not (match := _CORNERS.match(text)) or match.end() < len(text):
            self._refuse(b"f", text, match.end() if match else 0)
        starts, line = words_of(text)
        return text, starts, line, np.bincount(line, minlength=len(lines))

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
        found = np.full(len(starts), -1, np.int64)
        if word == b"vt" and not count:
            if have.any():
                self.notes.append("faces name texture coordinates, of which the file has none")
            return found
        digits = np.where(chosen, text, np.uint8(ord(" "))).tobytes().decode("ascii")
        numbers = np.fromstring(digits, np.int64, sep=" ")
        before = np.searchsorted(self.lines(word), lines[line[have]])
        index = np.where(numbers < 0, before + numbers, numbers - 1)
        wrong = (index < 0) | (index >= count)
        if wrong.any():
            first = int(wrong.argmax())
            face = np.searchsorted(self.lines(b"f"), lines[line[have][first]])
            index_text = f"face {face + 1:,} has the {word.decode()} index {numbers[first]}"
            raise self._fault(index_text, f"1 to {count:,}, or -1 and below")
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


def encode_obj(
    meshes: Sequence[Mesh], library: str | None = None, materials: Sequence[str] = (), origin: Floats | None = None
) -> Iterator[bytes]:
    """Yield the meshes as text.

    library: an .mtl file; materials: the name of each mesh's material in it; origin: what the positions are relative
    to, None for 0.
    """
    start = no_origin() if origin is None else origin
    far = bool(start.any())
    if library:
        yield f"mtllib {library}\n".encode("utf-8", "surrogateescape")
    names = materials or ([f"mesh_{number}" for number in range(len(meshes))] if len(meshes) > 1 else [])
    vertex, corner = 1, 1  # both count from 1 through the whole file
    for number, mesh in enumerate(meshes):
        if names:
            yield f"usemtl {names[number]}\n".encode()
        points: npt.NDArray[Any] = mesh.positions + start if far else mesh.positions
        form = "v" + (" %.15g" if far else " %.7g") * 3
        if mesh.colours is not None:
            points, form = np.concatenate([points, mesh.colours], axis=1), form + " %.7g" * 3
        yield _lines(form, points)
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
    return encode_obj(scene.meshes, origin=scene.origin)


def encode_files(
    scene: Meshes, stem: str, *, image: Literal["png", "jpeg"] = "png"
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the extension and the bytes of each file whose name is `stem` with an extension, the .obj first.

    A mesh without texture is an .obj alone. Raises InvalidScene for levels of detail.
    """
    _require_one_level(scene)
    textures = [mesh.texels for mesh in scene.meshes]
    if all(texture is None for texture in textures):
        yield ".obj", encode_obj(scene.meshes, origin=scene.origin)
        return
    ending = {"png": ".png", "jpeg": ".jpg"}[image]
    if any(mesh.opaque is not None for mesh in scene.meshes):
        ending = ".png"  # JPEG has no alpha
    pictures = [ending if len(textures) == 1 else f"_{number}{ending}" for number in range(len(textures))]
    names = [f"mesh_{number}" for number in range(len(textures))]
    yield ".obj", encode_obj(scene.meshes, f"{stem}.mtl", names, scene.origin)
    used = [None if each is None else stem + name for each, name in zip(textures, pictures, strict=True)]
    holed = [name for name, mesh in zip(names, scene.meshes, strict=True) if mesh.opaque is not None]
    yield ".mtl", [encode_mtl(list(zip(names, used, strict=True)), holed)]
    for texture, name in zip(textures, pictures, strict=True):
        if texture is not None:
            yield name, [encode_picture(texture, "png" if ending == ".png" else image)]


def _require_one_level(scene: Meshes) -> None:
    if scene.coarser:
        raise InvalidScene(Problem("the mesh", f"has {1 + len(scene.coarser)} levels of detail", "one, or .glb"))


def decode(view: memoryview, *, beside: Mapping[str, memoryview] | None = None) -> Meshes:
    """Parse meshes. Raises InvalidFile for invalid text or no faces, InvalidScene for invalid mesh values.

    beside: the files of the same folder, with materials and textures.
    """
    return decode_obj(view, "the mesh", beside)
