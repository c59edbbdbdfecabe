"""Wavefront .obj text as meshes, whole columns at a time. Materials stand in files of their own and are not looked for.

    v x y z [w] [r g b]     vt u v     usemtl NAME     f v[/vt[/vn]] v[/vt[/vn]] v[/vt[/vn]] ...

Indices count from 1 through the whole file, or back from the line that they stand in: -1 is the last one before it.
A \\ at a line's end joins it with the next, # starts a comment; what is not named here is passed over.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.scene.mesh import Mesh, require_few

_PER_BYTE = 8  # bytes that a byte of text takes while it is read
_PER_CORNER = 200  # and each corner of a polygon, of which there may be one in two bytes
_ALLOWED = "a whole .obj of polygons"
_NUMBER = rb"[-+]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++|nan|inf)(?:e[-+]?[0-9]++)?"
_NUMBERS = re.compile(rb"\s*+(?:" + _NUMBER + rb"(?:\s++|$))*+", re.IGNORECASE)
_INDEX = rb"-?[0-9]{1,18}+"
_CORNERS = re.compile(rb"\s*+(?:%b(?:/(?:%b)?(?:/(?:%b)?)?)?(?:\s++|$))*+" % (_INDEX, _INDEX, _INDEX))

Bytes = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


def decode_obj(view: memoryview, name: str) -> tuple[Mesh, ...]:
    """The meshes, one a material; vertices that meet different texture coordinates are split, unused ones dropped.

    Polygons become fans of triangles. Colours count where every vertex has one, texture coordinates where every corner
    of a mesh has. Raises InvalidFile, InvalidScene for values that no mesh can have, MemoryLimit.
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
        # In the order in which the file comes to its materials.
        return tuple(_mesh(corners, part, points, colours, places) for part in sorted(parts, key=lambda part: part[0]))


class _Corners(NamedTuple):
    """Of each triangle: vertices (t, 3), texture coordinates (t, 3) or -1 for none, material (t,)."""

    vertex: Ints
    place: Ints
    material: Ints


class _Numbers(NamedTuple):
    """All numbers of some lines one after the other, and (lines,) how many each has."""

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
    with np.errstate(over="ignore"):  # infinite then, which Mesh refuses
        return Mesh(
            points[used].astype(np.float32),
            None if uvs is None else uvs.astype(np.float32),
            faces.reshape(-1, 3).astype(np.uint32),
            colours=None if colours is None else colours[used].astype(np.float32),
        )


class _Text:
    """The file's bytes, where its lines are and what they start with."""

    def __init__(self, view: memoryview, name: str) -> None:
        self._name = name
        whole = bytes(view).replace(b"\\\r\n", b"  ").replace(b"\\\n", b" ")
        if b"#" in whole:
            whole = re.sub(rb"#[^\n]*+", b"", whole)
        # Every line starts with its first word, and has a byte behind it.
        self._bytes = np.frombuffer(re.sub(rb"\n[ \t\r\n]++", b"\n", b"\n" + whole + b"\n") + bytes(8), np.uint8)
        breaks = np.flatnonzero(self._bytes == ord("\n"))
        self._starts, self._ends = breaks[:-1] + 1, breaks[1:]

    def lines(self, word: bytes) -> Ints:
        """The numbers of the lines that start with this word."""
        found: npt.NDArray[np.bool_] = self._bytes[self._starts + len(word)] <= ord(" ")
        for k, letter in enumerate(word):
            found &= self._bytes[self._starts + k] == letter
        return np.flatnonzero(found & (self._ends - self._starts > len(word)))

    def numbers(self, lines: Ints) -> _Numbers:
        """What stands behind each line's word. Raises InvalidFile."""
        text = self._behind_words(lines)
        if not (match := _NUMBERS.match(text)) or match.end() < len(text):
            self._refuse(text, match.end() if match else 0)
        starts, line = _tokens(text)
        values = np.fromstring(text.decode("ascii"), np.float64, sep=" ")
        if len(values) != len(starts):
            raise self._fault(f"{len(starts):,} numbers, of which {len(values):,} are some", _ALLOWED)
        return _Numbers(values, np.bincount(line, minlength=len(lines)))

    def columns(self, numbers: _Numbers, first: int, end: int) -> Floats:
        """(lines, end - first) of each line's numbers. Raises InvalidFile where a line has fewer than `end`."""
        values, counts = numbers
        if (counts < end).any():
            raise self._fault(f"a line of {counts[(counts < end).argmax()]} numbers", f"{end} or more")
        begin = np.cumsum(counts) - counts
        return np.asarray(values[begin[:, None] + np.arange(first, end)], np.float64)

    def vertices(self) -> tuple[Floats, Floats | None]:
        """(v, 3) positions; (v, 3) colours, where all have one."""
        found = self.numbers(self.lines(b"v"))
        coloured = len(found.counts) and (found.counts >= 6).all()
        return self.columns(found, 0, 3), self.columns(found, 3, 6) if coloured else None

    def places(self) -> Floats:
        """(p, 2) texture coordinates."""
        return self.columns(self.numbers(self.lines(b"vt")), 0, 2)

    def corners(self, vertices: int, places: int) -> _Corners:
        """Of all triangles. Raises InvalidFile for polygons that are none, and indices of what there is not."""
        lines = self.lines(b"f")
        if not len(lines):
            raise self._fault("no faces", "at least one triangle", verb="has")
        text = self._behind_words(lines)
        if not (match := _CORNERS.match(text)) or match.end() < len(text):
            self._refuse(text, match.end() if match else 0)
        starts, line = _tokens(text)
        memory.hold(self._name, _PER_CORNER * len(starts))
        counts = np.bincount(line, minlength=len(lines))
        if (counts < 3).any():
            raise self._fault(f"face of {counts[(counts < 3).argmax()]} corners", "3 or more")
        split = np.frombuffer(text, np.uint8)
        slashes = np.cumsum(split == ord("/"), dtype=np.int32)
        widths = np.diff(np.concatenate([[0], starts[1:], [len(split)]]))
        slashes -= np.repeat(slashes[starts], widths)  # a corner starts with a digit or a sign
        vertex = self._indices(split, slashes, 0, starts, line, lines, b"v", vertices)
        place = self._indices(split, slashes, 1, starts, line, lines, b"vt", places)
        # A polygon's triangles: its first corner with each two neighbours of the others.
        triangles = np.repeat(counts - 2, counts - 2)
        polygon = np.repeat(np.arange(len(counts)), counts - 2)
        step = np.arange(len(triangles)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
        first = (np.cumsum(counts) - counts)[polygon]
        fan = np.stack([first, first + step + 1, first + step + 2], axis=1)
        return _Corners(vertex[fan], place[fan], self._materials(lines)[polygon])

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
        """(corners,) from 0; -1 where a corner has none."""
        chosen = (slashes == part) & (text > ord(" ")) & (text != ord("/"))
        have = np.logical_or.reduceat(chosen, starts)
        digits = np.where(chosen, text, np.uint8(ord(" "))).tobytes().decode("ascii")
        said = np.fromstring(digits, np.int64, sep=" ")
        before = np.searchsorted(self.lines(word), lines[line[have]])
        index = np.where(said < 0, before + said, said - 1)
        wrong = (index < 0) | (index >= count)
        if wrong.any():
            raise self._fault(
                f"corner of {word.decode()} {said[wrong.argmax()]}", f"1 to {count:,}, or back from there"
            )
        found = np.full(len(starts), -1, np.int64)
        found[have] = index
        return found

    def _materials(self, lines: Ints) -> Ints:
        """(faces,) the number of the material that each of these lines has."""
        uses = self.lines(b"usemtl")
        numbers: dict[bytes, int] = {}
        named = [
            numbers.setdefault(self._bytes[start:end].tobytes().strip(), 1 + len(numbers))
            for start, end in zip(self._starts[uses] + 6, self._ends[uses], strict=True)
        ]
        return np.array([0, *named])[np.searchsorted(uses, lines)]

    def _behind_words(self, lines: Ints) -> bytes:
        """These lines without their first word, each with its line break."""
        wanted = np.zeros(len(self._starts), bool)
        wanted[lines] = True
        mask = np.repeat(wanted, self._ends - self._starts + 1)
        mask[self._starts[lines] - 1] = False
        mask[self._starts[lines][self._bytes[self._starts[lines] + 1] > ord(" ")]] = False
        return bytes(self._bytes[1 : 1 + len(mask)][mask].data)

    def _refuse(self, text: bytes, at: int) -> None:
        said = text[at : at + 40].split()[0].decode("latin-1")
        raise self._fault(repr(said), _ALLOWED)

    def _fault(self, found: str, allowed: str, verb: str = "cannot be read: it has") -> InvalidFile:
        return InvalidFile(Problem(self._name, f"{verb} {found}", allowed))


def _tokens(text: bytes) -> tuple[Ints, Ints]:
    """Where each word starts, and in which line it stands."""
    bytes_ = np.frombuffer(text, np.uint8)
    solid = bytes_ > ord(" ")
    starts = np.flatnonzero(solid & ~np.concatenate([[False], solid[:-1]])) if len(solid) else np.empty(0, np.int64)
    return starts, np.searchsorted(np.flatnonzero(bytes_ == ord("\n")), starts)
