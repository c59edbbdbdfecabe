"""Fit nerf2mesh's specular MLP, sigmoid(relu([d, f] W0) W1), and its features to pixels: arrays in, arrays out.

The feature of a pixel is the mean over its lookups, each of the nearest texel. Pixels come in blocks; each block adds
its part of the weights' gradient by itself, and the parts are added in order. Texels change on one thread, in the order
of the pixels. So the result does not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints, Singles, f32
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.parallel import on_every_core

HIDDEN = 32  # units, as in nerf2mesh; a constant, so that the loops over them are unrolled
BLOCK = 64  # pixels that follow one another in memory


@compiled(merged=True)
def _nearest(at: Singles, entry: int) -> tuple[int, int]:
    return int(at[entry, 1] + f32(0.5)), int(at[entry, 0] + f32(0.5))


@compiled(merged=True)
def _sigmoid(x: np.float32) -> np.float32:
    s, q = compiled_exp_parts(-np.float64(x))
    return f32(1 / (1 + (s + s * q)))


@on_every_core
@compiled()
def specular(
    core: int,
    cores: int,
    at: Singles,
    starts: npt.NDArray[np.int32],
    directions: Singles,
    features: Singles,
    w0: Singles,
    w1: Singles,
    exact: bool,
    out: Singles,
) -> None:
    """Fill (p, 3): the specular colour of each pixel, with features (H, W, 3).

    exact: the mean of the colours of its lookups, as it is rendered; else the colour of the mean of their features,
    which takes a quarter of the time.
    """
    at, starts, directions, features, w0, w1, out = borrowed((at, starts, directions, features, w0, w1, out))
    begin, end = part_of(len(directions), core, cores)
    for i in range(begin, end):
        early = np.empty(HIDDEN, np.float32)
        for k in range(HIDDEN):
            early[k] = directions[i, 0] * w0[0, k] + directions[i, 1] * w0[1, k] + directions[i, 2] * w0[2, k]
        r, g, b = f32(0), f32(0), f32(0)
        f0, f1, f2 = f32(0), f32(0), f32(0)
        sr, sg, sb = f32(0), f32(0), f32(0)
        last = starts[i + 1] - 1
        before_y, before_x = -1, -1
        for entry in range(starts[i], last + 1):
            y, x = _nearest(at, entry)
            if exact:
                f0, f1, f2 = features[y, x, 0], features[y, x, 1], features[y, x, 2]
            else:
                f0, f1, f2 = f0 + features[y, x, 0], f1 + features[y, x, 1], f2 + features[y, x, 2]
                if entry < last:
                    continue
                share = f32(1) / f32(last + 1 - starts[i])
                f0, f1, f2 = f0 * share, f1 * share, f2 * share
            if not exact or y != before_y or x != before_x:
                zr, zg, zb = f32(0), f32(0), f32(0)
                for k in range(0, HIDDEN, 4):  # four units a pass: fewer sums wait for each other
                    a = max(early[k] + f0 * w0[3, k] + f1 * w0[4, k] + f2 * w0[5, k], f32(0))
                    p = k + 1
                    c = max(early[p] + f0 * w0[3, p] + f1 * w0[4, p] + f2 * w0[5, p], f32(0))
                    q = k + 2
                    d = max(early[q] + f0 * w0[3, q] + f1 * w0[4, q] + f2 * w0[5, q], f32(0))
                    s = k + 3
                    e = max(early[s] + f0 * w0[3, s] + f1 * w0[4, s] + f2 * w0[5, s], f32(0))
                    zr += a * w1[k, 0] + c * w1[p, 0] + d * w1[q, 0] + e * w1[s, 0]
                    zg += a * w1[k, 1] + c * w1[p, 1] + d * w1[q, 1] + e * w1[s, 1]
                    zb += a * w1[k, 2] + c * w1[p, 2] + d * w1[q, 2] + e * w1[s, 2]
                sr, sg, sb = _sigmoid(zr), _sigmoid(zg), _sigmoid(zb)
                before_y, before_x = y, x
            r, g, b = r + sr, g + sg, b + sb
        count = f32(last + 1 - starts[i]) if exact else f32(1)
        out[i, 0], out[i, 1], out[i, 2] = r / count, g / count, b / count


@on_every_core
@compiled()
def slopes(
    core: int,
    cores: int,
    blocks: Ints,
    at: Singles,
    starts: npt.NDArray[np.int32],
    directions: Singles,
    weights: Singles,
    rest: Singles,
    features: Singles,
    w0: Singles,
    w1: Singles,
    by_weight: Singles,
    by_feature: Singles,
) -> None:
    """Derivatives of half the squared error for the pixels of some blocks, with the sign of a step that lowers it.

    rest (p, 3): what the specular colour should be. by_weight (b, 9, HIDDEN): the rows of w0 and the columns of w1.
    by_feature (b, BLOCK, 6): of the pixel's feature, and the squares of the colours' derivatives, summed.
    """
    blocks, at, starts, directions, weights, rest, features, w0, w1, by_weight, by_feature = borrowed(
        (blocks, at, starts, directions, weights, rest, features, w0, w1, by_weight, by_feature)
    )
    for block in range(core, len(blocks), cores):
        h, on = np.empty(HIDDEN, np.float32), np.empty(HIDDEN, np.float32)
        sums = by_weight[block]
        sums[:] = f32(0)
        first = blocks[block] * BLOCK
        for i in range(first, min(first + BLOCK, len(rest))):
            f0, f1, f2 = f32(0), f32(0), f32(0)
            for entry in range(starts[i], starts[i + 1]):
                y, x = _nearest(at, entry)
                f0, f1, f2 = f0 + features[y, x, 0], f1 + features[y, x, 1], f2 + features[y, x, 2]
            share = f32(1) / f32(starts[i + 1] - starts[i])
            f0, f1, f2 = f0 * share, f1 * share, f2 * share
            d0, d1, d2 = directions[i, 0], directions[i, 1], directions[i, 2]
            for k in range(HIDDEN):
                z = d0 * w0[0, k] + d1 * w0[1, k] + d2 * w0[2, k] + f0 * w0[3, k] + f1 * w0[4, k] + f2 * w0[5, k]
                h[k] = max(z, f32(0))
                on[k] = f32(1) if z > f32(0) else f32(0)
            zr, zg, zb = f32(0), f32(0), f32(0)
            r0, r1, r2 = f32(0), f32(0), f32(0)
            g0, g1, g2 = f32(0), f32(0), f32(0)
            b0, b1, b2 = f32(0), f32(0), f32(0)
            for k in range(HIDDEN):
                zr, zg, zb = zr + h[k] * w1[k, 0], zg + h[k] * w1[k, 1], zb + h[k] * w1[k, 2]
                p, q, s = on[k] * w1[k, 0], on[k] * w1[k, 1], on[k] * w1[k, 2]
                r0, r1, r2 = r0 + p * w0[3, k], r1 + p * w0[4, k], r2 + p * w0[5, k]
                g0, g1, g2 = g0 + q * w0[3, k], g1 + q * w0[4, k], g2 + q * w0[5, k]
                b0, b1, b2 = b0 + s * w0[3, k], b1 + s * w0[4, k], b2 + s * w0[5, k]
            sr, sg, sb = _sigmoid(zr), _sigmoid(zg), _sigmoid(zb)
            tr, tg, tb = sr * (f32(1) - sr), sg * (f32(1) - sg), sb * (f32(1) - sb)
            w = weights[i]
            er, eg, eb = w * (rest[i, 0] - sr) * tr, w * (rest[i, 1] - sg) * tg, w * (rest[i, 2] - sb) * tb
            for k in range(HIDDEN):
                back = on[k] * (er * w1[k, 0] + eg * w1[k, 1] + eb * w1[k, 2])
                sums[0, k] += d0 * back
                sums[1, k] += d1 * back
                sums[2, k] += d2 * back
                sums[3, k] += f0 * back
                sums[4, k] += f1 * back
                sums[5, k] += f2 * back
                sums[6, k] += er * h[k]
                sums[7, k] += eg * h[k]
                sums[8, k] += eb * h[k]
            out = by_feature[block, i - first]
            out[0], out[1], out[2] = (
                er * r0 + eg * g0 + eb * b0,
                er * r1 + eg * g1 + eb * b1,
                er * r2 + eg * g2 + eb * b2,
            )
            vr, vg, vb = w * tr * tr, w * tg * tg, w * tb * tb
            out[3] = vr * r0 * r0 + vg * g0 * g0 + vb * b0 * b0
            out[4] = vr * r1 * r1 + vg * g1 * g1 + vb * b1 * b1
            out[5] = vr * r2 * r2 + vg * g2 * g2 + vb * b2 * b2


@compiled()
def move_features(
    blocks: Ints,
    at: Singles,
    starts: npt.NDArray[np.int32],
    by_feature: Singles,
    rate: float,
    least: float,
    steepness: Singles,
    features: Singles,
) -> None:
    """Move the texels that the pixels of some blocks show, and keep them in 0..1.

    steepness (H, W, 3) sums the squares of the derivatives over all pixels so far. A step is `rate` times the
    derivative, divided by `least` plus the steepness, a quarter of which is that of all three coordinates together.
    """
    p, eager = len(starts) - 1, f32(rate)
    for block in range(len(blocks)):
        first = blocks[block] * BLOCK
        for i in range(first, min(first + BLOCK, p)):
            out = by_feature[block, i - first]
            share = f32(1) / f32(starts[i + 1] - starts[i])
            for entry in range(starts[i], starts[i + 1]):
                y, x = _nearest(at, entry)
                s = steepness[y, x]
                s[0] += share * out[3]
                s[1] += share * out[4]
                s[2] += share * out[5]
                other = f32(0.25) * (s[0] + s[1] + s[2]) + f32(least)
                for axis in range(3):
                    moved = features[y, x, axis] + eager * share * out[axis] / (f32(0.75) * s[axis] + other)
                    features[y, x, axis] = min(max(moved, f32(0)), f32(1))
