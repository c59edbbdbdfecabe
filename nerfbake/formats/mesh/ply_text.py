"""Read the elements of a .ply in text as columns of numbers.

The format makes each row a line. Some programs break rows into several lines, or put several on one; others
(MeshLab's VCGLIB) write more numbers in a row than the header declares. If each row is a line of the declared
numbers, both readings agree. Else the numbers are counted as declared if that ends with the last one; else the lines
count, and further numbers in a line are skipped.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.mesh.words import words_of
from nerfbake.formats.wire.ply import Element
from nerfbake.kernels.arrays import Floats, Ints

_ALLOWED = "a whole .ply of polygons"
_WORD = 90  # bytes of memory per word of text
LONGER = "rows have more numbers than the header declares, which are skipped"


class TextRows(NamedTuple):
    """The rows of an element: its numbers by name, or the entries of a list, row after row, and their counts."""

    columns: dict[str, Floats]
    entries: Floats
    counts: Ints


_EMPTY = TextRows({}, np.empty(0), np.empty(0, np.int64))


class _Short(Exception):
    """A line has fewer numbers than its row."""


def parse_text(
    view: memoryview, elements: Sequence[Element], lists: Sequence[int], after: int
) -> tuple[list[TextRows], list[str]]:
    """Return the rows of each element, and notes. Raises InvalidFile, MemoryLimit.

    view: from the first row on; lists: the index of the wanted list of each element, -1 for none; after: how many
    numbers follow the elements
    """
    memory.hold("the mesh", _WORD * len(view) // 2)
    numbers, lines = _parsed(bytes(view))
    try:
        found, longer = _by_line(numbers, lines, elements, lists)
    except _Short:
        return _by_number(numbers, elements, lists)[0], []
    if not longer:
        return found, []
    try:
        counted, left = _by_number(numbers, elements, lists)
    except InvalidFile:
        return found, [LONGER]
    return (counted, []) if left == after else (found, [LONGER])


def _parsed(text: bytes) -> tuple[Floats, Ints]:
    """Return all numbers, and for each line that is not empty the index of its first one; then the count of numbers."""
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")
    starts, line = words_of(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # of text that is not numbers
        try:
            numbers = np.fromstring(text.decode("ascii"), np.float64, sep=" ") if len(starts) else np.empty(0)
        except (DeprecationWarning, ValueError):
            numbers = np.empty(0)
    if len(numbers) != len(starts):
        raise InvalidFile(Problem("the mesh", "has words that are no numbers", _ALLOWED))
    return numbers, np.append(np.flatnonzero(np.diff(line, prepend=-1)), len(numbers))


def _by_line(
    numbers: Floats, lines: Ints, elements: Sequence[Element], lists: Sequence[int]
) -> tuple[list[TextRows], bool]:
    """Read each row from a line, and tell whether lines are longer than rows. Raises _Short if any is shorter."""
    found, first, longer = [], 0, False
    for element, wanted in zip(elements, lists, strict=True):
        if not element.properties:
            found.append(_EMPTY)
            continue
        if first + element.rows >= len(lines):
            raise _Short
        bounds = lines[first : first + element.rows + 1]
        at, ends = bounds[:-1].copy(), bounds[1:]
        columns: dict[str, Floats] = {}
        rows = _EMPTY._replace(columns=columns)
        if not element.lists and (ends - at == len(element.properties)).all():
            table = numbers[bounds[0] : bounds[-1]].reshape(element.rows, -1)
            columns |= {each.name: table[:, k] for k, each in enumerate(element.properties)}
            at = ends
        else:
            for k, each in enumerate(element.properties):
                if (at >= ends).any():
                    raise _Short
                if each.counts is None:
                    columns[each.name] = numbers[at]
                    at += 1
                    continue
                counts = _lengths(numbers[at])
                at += 1
                if (counts > ends - at).any():
                    raise _Short
                if k == wanted:
                    rows = rows._replace(entries=_entries(numbers, at, counts), counts=counts)
                at += counts
        longer |= bool((at < ends).any())
        found.append(rows)
        first += element.rows
    return found, longer


def _lengths(values: Floats) -> Ints:
    """Return the lengths of lists. Raises _Short for numbers that are no length."""
    if not ((values >= 0) & (values < 2**31) & (values == np.rint(values))).all():
        raise _Short
    return values.astype(np.int64)


def _entries(numbers: Floats, at: Ints, counts: Ints) -> Floats:
    """Return the entries of lists that start at `at`, one list after the other."""
    if len(counts) and (counts == counts[0]).all():
        places = (at[:, None] + np.arange(counts[0])).reshape(-1)
    else:
        places = np.repeat(at, counts) + np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    found: Floats = numbers[places]
    return found


def _by_number(numbers: Floats, elements: Sequence[Element], lists: Sequence[int]) -> tuple[list[TextRows], int]:
    """Read as many numbers for each row as the header declares, and return how many are left. Raises InvalidFile."""
    found, at = [], 0
    for element, wanted in zip(elements, lists, strict=True):
        columns = len(element.properties)
        if element.rows * columns > len(numbers) - at:
            what = f"declares {element.rows:,} rows, with {len(numbers) - at:,} numbers left"
            raise InvalidFile(Problem(f"element {element.name[:40]}", what, _ALLOWED))
        if element.lists:
            starts, counts, at = _walk(numbers, element, wanted, at)
            found.append(TextRows({}, _entries(numbers, starts, counts), counts))
            continue
        table = numbers[at : at + element.rows * columns].reshape(element.rows, columns)
        found.append(_EMPTY._replace(columns={each.name: table[:, k] for k, each in enumerate(element.properties)}))
        at += element.rows * columns
    return found, len(numbers) - at


def _walk(numbers: Floats, element: Element, wanted: int, at: int) -> tuple[Ints, Ints, int]:
    """Return the start and the length of the wanted list in each row, and where the rows end. Raises InvalidFile."""
    starts, counts = np.zeros(element.rows, np.int64), np.zeros(element.rows, np.int64)
    first = at
    for row in range(element.rows):
        for k, each in enumerate(element.properties):
            count = 1
            if each.counts is not None:
                length = numbers[at] if at < len(numbers) else -1.0
                if not 0 <= length <= len(numbers):
                    raise InvalidFile(Problem("element face", "does not end within the file", _ALLOWED))
                count, at = int(length), at + 1
            if k == wanted:
                starts[row], counts[row] = at, count
            at += count
    if at > len(numbers):
        what = f"declares {element.rows:,} rows, with {len(numbers) - first:,} numbers left"
        raise InvalidFile(Problem("element face", what, _ALLOWED))
    return starts, counts, at
