"""Samples along rays through a lattice at equal steps, as the programs that train such fields take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.lattice.blocks import empty_steps
from nerfbake.kernels.lattice.nodes import DensityNodes, density_at
from nerfbake.kernels.parallel import on_every_core

_BLOCK = 64  # rays that a core processes before it takes the next block


class Samples(NamedTuple):
    """The samples of m rays: those of ray i are first[i] to first[i + 1], in order.

    places (k, 3) in the box; weights (k,): the share of the ray's light that each absorbs. lost (m, 2): the light that
    each ray loses in total, and the sum of these weights times distance.
    """

    first: Ints
    places: Floats
    weights: Singles
    lost: Floats


def samples_of(nodes: DensityNodes, origin: Floats, directions: Floats, step: float, cut: float) -> Samples:
    """Sample the rays.

    origin (3,) and directions (m, 3) in fractions of the box; a direction is one world unit long. step in world units.
    A ray stops when its transmittance falls below `cut`.
    """
    m = len(directions)
    counts, spans, lost = np.zeros(m + 1, np.int64), np.zeros((m, 2), np.int64), np.zeros((m, 2))
    places, weights = np.zeros((0, 3)), np.zeros(0, np.float32)
    _march(nodes, origin, directions, step, cut, False, counts, spans, places, weights, lost)
    first = np.cumsum(counts)
    places, weights = np.empty((int(first[-1]), 3)), np.empty(int(first[-1]), np.float32)
    _march(nodes, origin, directions, step, cut, True, first, spans, places, weights, lost)
    return Samples(first, places, weights, lost)


def composite_colours(samples: Samples, colours: Singles) -> Singles:
    """(m, 3) weighted sums of the colours (k, 3) of each ray's samples."""
    out = np.empty((len(samples.lost), 3), np.float32)
    _gather(samples.first, samples.weights, colours, out)
    return out


def composite_values(samples: Samples, values: Singles) -> Singles:
    """(m, C) weighted sums of any values (k, C) of each ray's samples."""
    out = np.zeros((len(samples.lost), values.shape[1]), np.float32)
    _sum(samples.first, samples.weights, values, out)
    return out


@on_every_core
@compiled()
def _march(
    core: int,
    cores: int,
    nodes: DensityNodes,
    origin: Floats,
    directions: Floats,
    step: float,
    cut: float,
    keep: bool,
    first: Ints,
    spans: Ints,
    places: Floats,
    weights: Singles,
    lost: Floats,
) -> None:
    """One of two passes over the samples.

    keep False: count each ray's samples in first[ray + 1], and write the range of steps that contains them to spans (m,
    2). keep True: visit only these steps, and write the samples from first[ray] on.
    """
    nodes, origin, directions, first, spans, places, weights, lost = borrowed(
        (nodes, origin, directions, first, spans, places, weights, lost)
    )
    m = len(directions)
    for block in range(core, (m + _BLOCK - 1) // _BLOCK, cores):
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, m)):
            start, end = _span(origin, directions, ray)
            through, far, number = 1.0, 0.0, 0
            low, high = 0, int(max(np.ceil((end - start) / step), 0.0))
            if keep:
                low, high = spans[ray, 0], spans[ray, 1]
            i, ahead = low, 1
            while i < high:
                t = start + i * step
                u = min(max(origin[0] + t * directions[ray, 0], 0.0), 1.0)
                v = min(max(origin[1] + t * directions[ray, 1], 0.0), 1.0)
                w = min(max(origin[2] + t * directions[ray, 2], 0.0), 1.0)
                density = density_at(nodes, u, v, w)
                if density <= 0:
                    if nodes.edge > 0:
                        x, y, z = directions[ray, 0] * step, directions[ray, 1] * step, directions[ray, 2] * step
                        ahead = empty_steps(nodes, u, v, w, x, y, z)
                    i += ahead
                    continue
                whole, rest = compiled_exp_parts(-density * step)
                kept = whole + whole * rest
                weight = through * (1 - kept)
                if keep:
                    at = first[ray] + number
                    places[at, 0], places[at, 1], places[at, 2], weights[at] = u, v, w, weight
                elif number == 0:
                    spans[ray, 0] = i
                spans[ray, 1] = i + 1
                number += 1
                far += weight * t
                through *= kept
                i += 1
                if through < cut:
                    break
            if not keep:
                first[ray + 1] = number
            lost[ray, 0], lost[ray, 1] = 1 - through, far


@compiled()
def _span(origin: Floats, directions: Floats, ray: int) -> tuple[float, float]:
    """Where a ray enters and leaves the box, in world units; never before its origin."""
    start, end = 0.0, np.inf
    for axis in range(3):
        d, o = directions[ray, axis], origin[axis]
        if d != 0:
            start, end = max(start, min(-o / d, (1 - o) / d)), min(end, max(-o / d, (1 - o) / d))
        elif o < 0 or o > 1:
            end = -1.0
    return start, max(start, end)


@on_every_core
@compiled()
def _gather(core: int, cores: int, first: Ints, weights: Singles, colours: Singles, out: Singles) -> None:
    begin, end = part_of(len(out), core, cores)
    for ray in range(begin, end):
        red, green, blue = 0.0, 0.0, 0.0
        for i in range(first[ray], first[ray + 1]):
            red += weights[i] * colours[i, 0]
            green += weights[i] * colours[i, 1]
            blue += weights[i] * colours[i, 2]
        out[ray, 0], out[ray, 1], out[ray, 2] = red, green, blue


@on_every_core
@compiled()
def _sum(core: int, cores: int, first: Ints, weights: Singles, values: Singles, out: Singles) -> None:
    begin, end = part_of(len(out), core, cores)
    for ray in range(begin, end):
        total = out[ray]
        for i in range(first[ray], first[ray + 1]):
            weight, own = weights[i], values[i]
            for column in range(len(total)):
                total[column] += weight * own[column]
