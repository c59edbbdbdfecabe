"""Splats -> fewer splats: those of a box, those without floaters, the largest connected part, or merged ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Floats, Ints
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.kernels.splat.merging import Mixture, choose_pairs, fill_axes, fill_forms, find_partners, merge_pairs
from nerfbake.kernels.surface.triangles import parts_of
from nerfbake.scene.basis import SH0
from nerfbake.scene.splats import Splats
from nerfbake.stages.splat_box import inner_box

_PIXELS = 400  # along the scene: what is smaller than such a pixel is compared as it looks, blurred by it
_BLUR = 0.3  # variance that a picture adds, in square pixels
_SHARPEST = 1e-9  # of the longest edge: blur of antialiased splats, which pictures do not widen
_REACH = 16  # splats before and after one, in Morton order, that it may be merged with
_LESS = 4  # a round removes at most one of so many splats, so that only good pairs are merged
_LEVEL = 21  # bits of a Morton code along an axis
_BYTES = 300  # of a splat while it is merged
# Cells for what is near: a 64th of the scene; of few or large splats more, so that those of a surface touch.
_CELLS, _SPACINGS, _SIZES = 64, 3.0, 2.0
_COMPANY = 2.0  # opacity of all others in 27 cells below which a splat is isolated, or in a faint cloud
_HUGE = 0.25  # standard deviation, of the longest edge, of splats that must not stand outside
_HOLDS = 0.1  # opacity from which a splat connects parts
_MIDDLE = 1 << 20  # cells from the middle to each end of a grid
_CELL_BYTES = 200


def merge_splats(splats: Splats, *, count: int) -> Splats:
    """Return at most `count` splats: pairs of neighbours are merged, those first that this changes least.

    A union has the mean and the covariance of the pair, weighted by light, the SH weighted alike, and the opacity with
    which it covers as much as the pair. What is not merged keeps its bytes, and all keep their order. Fit the result to
    pictures of the original afterwards: 4 dB in a real scene that keeps one splat of five. The bytes do not depend
    on the number of threads.

    Raises InvalidScene for a count below 1, MemoryLimit. Source: none; pairs by the moments of their mixture are usual.

    >>> from nerfbake import build_field, build_splats, merge_splats, sample_n3tree
    >>> print(merge_splats(build_splats(build_field(sample_n3tree(resolution=8))), count=20))
    20 splats of SH degree 2
    """
    splats.require_usable()
    if count < 1:
        raise InvalidScene(Problem("count", f"is {count}", "1 or more"))
    if splats.n <= count:
        return splats
    memory.require(f"merging {splats.n:,} splats", splats.n * (_BYTES + 12 * splats.B))
    box = inner_box(splats, opacity_min=0)
    edge = float((box[1] - box[0]).max())
    blur = (_SHARPEST * edge) ** 2 if splats.antialiased else _BLUR * (edge / _PIXELS) ** 2
    blur = max(blur, 1e-60)
    form, n = np.empty((splats.n, 6)), splats.n
    fill_forms(splats.scales, splats.quats, form)
    colour = np.clip(0.5 + SH0 * splats.sh[:, 0].astype(np.float64), 0, 1)
    state = Mixture(splats.means.astype(np.float64), form, splats.opacity.astype(np.float64), colour, np.arange(n))
    sh, merged, turn = splats.sh.copy(), np.zeros(n, np.bool_), 0
    while n > count:
        progress.report((splats.n - n) / (splats.n - count))
        state = _rows(state, _along(state.centre, turn))
        partners, errors = np.empty(n, np.int32), np.empty(n)
        find_partners(state, blur, _REACH, partners, errors)
        taken, pairs = np.zeros(n, np.bool_), np.empty((min(n - count, -(-n // _LESS)), 2), np.int32)
        pairs = pairs[: choose_pairs(np.argsort(errors, kind="stable"), partners, taken, pairs)]
        merge_pairs(state, sh, pairs, blur)
        merged[state.row[pairs[:, 0]]] = True
        held = np.ones(n, np.bool_)
        held[pairs[:, 1]] = False
        state = _rows(state, np.flatnonzero(held))
        n, turn = len(state.row), turn + 1
    state = _rows(state, np.argsort(state.row))
    rows, new = state.row, merged[state.row]
    means, scales, quats, opacity = (each[rows] for each in (splats.means, splats.scales, splats.quats, splats.opacity))
    means[new], opacity[new] = cast(state.centre[new], np.float32), cast(state.opacity[new], np.float32)
    sizes, turns = np.empty((int(new.sum()), 3), np.float32), np.empty((int(new.sum()), 4), np.float32)
    fill_axes(state.form[new], sizes, turns)
    scales[new], quats[new] = sizes, turns
    return memory.kept(replace(splats, means=means, scales=scales, quats=quats, opacity=opacity, sh=sh[rows]))


def _rows(state: Mixture, rows: Ints) -> Mixture:
    return Mixture(state.centre[rows], state.form[rows], state.opacity[rows], state.colour[rows], state.row[rows])


def _along(centre: Floats, turn: int) -> Ints:
    """Return the order of points (n, 3) along a Morton curve.

    Neighbours on both sides of a wall between large cubes are far apart on it, so that each turn has other walls.
    """
    low, high = centre.min(axis=0), centre.max(axis=0)
    edge = max(float((high - low).max()), 1e-30)
    shift = (turn * 0.618033988749895) % 1.0 / 2
    cells = np.minimum((((centre - low) / edge + shift) * (2 / 3) * 2**_LEVEL).astype(np.int64), 2**_LEVEL - 1)
    return np.argsort(sum(dilate(cells[:, axis]) << axis for axis in range(3)), kind="stable")


def cut_floaters(splats: Splats) -> Splats:
    """Return the splats without isolated ones, faint clouds, and huge ones far outside; the rest keep their order.

    Space is divided into cells of a 64th of the scene's longest edge, larger for few or large splats. A splat is
    dropped if the opacities of all others in its cell and the 26 around it sum to less than 2, or if its centre is
    outside inner_box() and its largest standard deviation is above a quarter of the longest edge. Raises InvalidScene
    if none is left, MemoryLimit. Source: none.

    >>> import numpy as np
    >>> from nerfbake import Splats, cut_floaters
    >>> places = np.concatenate([np.random.default_rng(0).uniform(size=(200, 3)), [[9, 9, 9]]]).astype(np.float32)
    >>> sizes, turns = np.full((201, 3), 0.02, np.float32), np.tile(np.float32([1, 0, 0, 0]), (201, 1))
    >>> scene = Splats(places, sizes, turns, np.ones(201, np.float32), np.zeros((201, 1, 3), np.float32))
    >>> print(cut_floaters(scene))
    200 splats of SH degree 0
    """
    grid = _grid_of(splats)
    sums = np.bincount(grid.cells, splats.opacity.astype(np.float64))
    around = sums.copy()
    for cells, others in _neighbours(grid.keys):
        around[cells] += sums[others]
        around[others] += sums[cells]
    company = around[grid.cells] - splats.opacity
    outside = ((splats.means < grid.box[0]) | (splats.means > grid.box[1])).any(axis=1)
    huge = splats.scales.max(axis=1) > _HUGE * grid.edge
    return _taken(splats, (company >= _COMPANY) & ~(outside & huge), "are all floaters")


def cut_largest_part(splats: Splats) -> Splats:
    """Return the connected part with the most splats, in their order.

    Cells, as of cut_floaters(), are connected if they touch and hold splats of an opacity of at least 0.1. Thinner
    splats belong to the part whose cells they are in or beside. Raises InvalidScene if no splat is that opaque,
    MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import Splats, cut_largest_part
    >>> places = np.concatenate([np.random.default_rng(0).uniform(size=(200, 3)), [[9, 9, 9]]]).astype(np.float32)
    >>> sizes, turns = np.full((201, 3), 0.02, np.float32), np.tile(np.float32([1, 0, 0, 0]), (201, 1))
    >>> scene = Splats(places, sizes, turns, np.ones(201, np.float32), np.zeros((201, 1, 3), np.float32))
    >>> print(cut_largest_part(scene))
    200 splats of SH degree 0
    """
    grid = _grid_of(splats)
    held = np.zeros(len(grid.keys), np.bool_)
    held[grid.cells[splats.opacity >= _HOLDS]] = True
    links = [np.stack(pair, axis=1)[held[pair[0]] & held[pair[1]]] for pair in _neighbours(grid.keys)]
    own = np.arange(len(grid.keys))
    triples = np.concatenate([np.stack([own, own, own], axis=1), *(link[:, [0, 1, 1]] for link in links)])
    part = parts_of(triples, len(own))[: len(own)]
    counts = np.bincount(part[grid.cells], held[grid.cells])
    inside = held & (part == int(np.argmax(counts)))
    near = inside.copy()
    for cells, others in _neighbours(grid.keys):
        near[cells] |= inside[others]
        near[others] |= inside[cells]
    opaque = splats.opacity >= _HOLDS
    kept = np.where(opaque, inside[grid.cells], near[grid.cells])
    return _taken(splats, kept, f"have opacities below {_HOLDS}")


class _Grid(NamedTuple):
    """box (2, 3): inner_box(); edge: its longest one. keys (k,): of the occupied cells, rising. cells (n,): of each."""

    box: Floats
    edge: float
    keys: Ints
    cells: Ints


def _grid_of(splats: Splats) -> _Grid:
    splats.require_usable()
    memory.require(f"cells of {splats.n:,} splats", _CELL_BYTES * splats.n)
    box = inner_box(splats, opacity_min=0)
    edge = float((box[1] - box[0]).max())
    usual = float(np.sort(splats.scales.max(axis=1))[splats.n // 2])
    cell = max(edge / _CELLS, edge * _SPACINGS / float(np.sqrt(splats.n)), _SIZES * usual, 1e-30)
    places = np.floor((splats.means.astype(np.float64) - box.mean(axis=0)) / cell)
    steps = np.clip(places, 2 - _MIDDLE, _MIDDLE - 2).astype(np.int64) + _MIDDLE
    keys, cells = np.unique(steps[:, 0] << 42 | steps[:, 1] << 21 | steps[:, 2], return_inverse=True)
    return _Grid(box, edge, keys, cells.reshape(-1))


def _neighbours(keys: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Yield the pairs of occupied cells that touch, each pair once: for each of 13 directions the rows of both."""
    for x, y, z in product((-1, 0, 1), repeat=3):
        offset = (x << 42) + (y << 21) + z
        if offset > 0:
            found = np.minimum(np.searchsorted(keys, keys + offset), len(keys) - 1)
            met = keys[found] == keys + offset
            yield np.flatnonzero(met), found[met]


def _taken(splats: Splats, kept: Bits, found: str) -> Splats:
    """Return these splats. found: what is wrong if there are none."""
    if not kept.any():
        raise InvalidScene(Problem("the splats", found, "some that are near others"))
    if kept.all():
        return splats
    return memory.kept(splats.take(kept))
