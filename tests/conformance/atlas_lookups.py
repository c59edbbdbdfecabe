"""What an atlas shows at a texel in a direction, a number at a time, by the conventions that atlas.json spells out."""

from __future__ import annotations

from math import floor
from typing import Any

from tests.conformance.case import Facts

Row = list[float]


def colour_of(facts: Facts, texel: tuple[int, int], direction: Row) -> Facts:
    """The specular colour by each of the three lookups."""
    terms = _terms(facts, texel)
    u, v = _square(direction)
    found = {}
    for name, read in (("bilinear", _bilinear), ("nearest", _nearest), ("thesis", _thesis)):
        colour = [0.0] * 3
        for tile, weight, sloped in terms:
            shown = read(facts["tiles"][tile], u, v)
            decoded = [(byte - 128) / 127 if sloped else byte / 255 for byte in shown]
            colour = [c + weight * d for c, d in zip(colour, decoded, strict=True)]
        found[name] = colour
    return found


def _terms(facts: Facts, texel: tuple[int, int]) -> list[tuple[int, float, bool]]:
    """Tiles with their weights; True for those that hold slopes."""
    row, column = texel
    label = facts["labels"][row][column]
    if facts["method"] == "kmeans":
        return [(label, 1.0, False)]
    feature = facts["features"][row][column]
    if facts["method"] == "affine":
        scale = facts["slope"] * facts["slopes"][label] / 255
        slopes = [(4 * label + 1 + i, scale * (byte - 127) / 255, True) for i, byte in enumerate(feature)]
        return [(4 * label, 1.0, False), *slopes]
    n = round(len(facts["tiles"]) ** (1 / 3))
    place = [byte * (n - 1) / 255 for byte in feature]
    low = [min(floor(p), n - 2) for p in place]
    rest = [p - start for p, start in zip(place, low, strict=True)]
    corner, terms = (low[0] * n + low[1]) * n + low[2], []
    before = 1.0
    for axis in sorted(range(3), key=lambda axis: -rest[axis]):
        terms.append((corner, before - rest[axis], False))
        corner, before = corner + n ** (2 - axis), rest[axis]
    return [*terms, (corner, before, False)]


def _square(direction: Row) -> tuple[float, float]:
    """Where a direction lies in the unfolded octahedron: u along a row, v down, both 0 to 1."""
    x, y, z = (d / sum(map(abs, direction)) for d in direction)
    if y < 0:
        x, z = (1 - abs(z)) * (-1 if x < 0 else 1), (1 - abs(x)) * (-1 if z < 0 else 1)
    return x / 2 + 0.5, z / 2 + 0.5


def _nearest(tile: Any, u: float, v: float) -> Row:
    size = len(tile)
    row: Row = tile[min(floor(v * size), size - 1)][min(floor(u * size), size - 1)]
    return row


def _thesis(tile: Any, u: float, v: float) -> Row:
    last = len(tile) - 1
    row: Row = tile[int(v * last)][int(u * last)]
    return row


def _bilinear(tile: Any, u: float, v: float) -> Row:
    size = len(tile)
    x, y = u * size - 0.5, v * size - 0.5
    column, row = floor(x), floor(y)
    shown = [0.0] * 3
    for down in (0, 1):
        for right in (0, 1):
            weight = (x - column if right else 1 - (x - column)) * (y - row if down else 1 - (y - row))
            texel = _beyond(tile, row + down, column + right)
            shown = [s + weight * t for s, t in zip(shown, texel, strict=True)]
    return shown


def _beyond(tile: Any, row: int, column: int) -> Row:
    """A texel, also one step outside the square: over an edge comes back over the same edge, mirrored about its
    middle."""
    size = len(tile)
    if not 0 <= column < size:
        row, column = size - 1 - row, min(max(column, 0), size - 1)
    if not 0 <= row < size:
        row, column = min(max(row, 0), size - 1), size - 1 - column
    texel: Row = tile[row][column]
    return texel
