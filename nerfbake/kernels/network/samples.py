"""Samples along rays through a trained function, with steps that grow with the distance where space is contracted.

Distances are in trained units. Steps that a grid of cells marks as empty are passed over.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.parallel import on_every_core


class RayWalk(NamedTuple):
    """Where rays go.

    origin (3,) and unit directions (m, 3); spans (m, 2): where they start and end. step: its length, where |x|, the
    largest coordinate, is below 1 or space is not contracted; elsewhere it is |x|^2 times as long.

    filled     (G, G, G) the cells, over the box `low`, `size` (3,) of the contracted space, that steps are taken in
    """

    origin: Floats
    directions: Floats
    spans: Floats
    step: float
    contracted: bool
    filled: Bits
    low: Floats
    size: Floats


def next_samples(walk: RayWalk, rays: Ints, at: Floats, most: int) -> tuple[Ints, Floats]:
    """Return how many samples each of these rays takes next, at most `most`, and their steps.

    rays (k,): numbers of the rays; at (m,): where each ray is, which is moved on. Returns (k,), and the begin and the
    length of each step (k, most, 2).
    """
    counts, steps = np.zeros(len(rays), np.int64), np.empty((len(rays), most, 2))
    _step(walk, rays, at, counts, steps)
    return counts, steps


def absorb(counts: Ints, steps: Floats, thickness: Floats, rays: Ints, left: Floats, sums: Floats) -> Singles:
    """Return the weight of each sample, and update the rays.

    thickness (s,): the optical thickness of the samples, ray after ray. left (m,): the transmittance of each ray. sums
    (m, 2): the sums of the weights, and of weight times distance.
    """
    weights = np.empty(len(thickness), np.float32)
    _absorb(counts, np.cumsum(counts) - counts, steps, thickness, rays, left, sums, weights)
    return weights


@on_every_core
@compiled()
def _step(core: int, cores: int, walk: RayWalk, rays: Ints, at: Floats, counts: Ints, steps: Floats) -> None:
    walk, rays, at, counts, steps = borrowed((walk, rays, at, counts, steps))
    begin, end = part_of(len(rays), core, cores)
    G, most = walk.filled.shape[0], steps.shape[1]
    for k in range(begin, end):
        ray = rays[k]
        t, stop, count = at[ray], walk.spans[ray, 1], 0
        while t < stop and count < most:
            far = 0.0
            for axis in range(3):
                far = max(far, abs(walk.origin[axis] + t * walk.directions[ray, axis]))
            length = walk.step * far * far if walk.contracted and far > 1 else walk.step
            length = min(length, stop - t)
            middle, far = t + 0.5 * length, 0.0
            for axis in range(3):
                far = max(far, abs(walk.origin[axis] + middle * walk.directions[ray, axis]))
            scale = (2 - 1 / far) / far if walk.contracted and far > 1 else 1.0
            filled = True
            x, y, z = 0, 0, 0
            for axis in range(3):
                place = (walk.origin[axis] + middle * walk.directions[ray, axis]) * scale
                cell = int(min(max((place - walk.low[axis]) / walk.size[axis] * G, 0.0), G - 1.0))
                x, y, z = y, z, cell
            filled = walk.filled[x, y, z]
            if filled:
                steps[k, count, 0], steps[k, count, 1] = t, length
                count += 1
            t = t + length
            if length < 1e-12 * stop:
                break
        at[ray] = t if t < stop and count == most else stop
        counts[k] = count


@compiled()
def _absorb(
    counts: Ints,
    first: Ints,
    steps: Floats,
    thickness: Floats,
    rays: Ints,
    left: Floats,
    sums: Floats,
    weights: Singles,
) -> None:
    for k in range(len(rays)):
        ray = rays[k]
        for i in range(counts[k]):
            whole, rest = compiled_exp_parts(-thickness[first[k] + i])
            behind = left[ray] * (whole + whole * rest)
            weight = left[ray] - behind
            weights[first[k] + i] = weight
            sums[ray, 0] += weight
            sums[ray, 1] += weight * (steps[k, i, 0] + 0.5 * steps[k, i, 1])
            left[ray] = behind
