"""Texels from the pixels that show them: lookups, their transpose, and a least-squares problem; arrays in, arrays out.

A pixel is the mean of several bilinear lookups, one for each of its rays that hits the surface. The normal equations of
single lookups couple a texel with its 8 neighbours, so they are kept as 5 numbers a texel (their matrix is symmetric).
For pixels of several rays this matrix is an upper bound of the true one: a step that solves it for the pixels'
residuals never increases the error (majorisation), and a few of them are enough.

Loops that add to texels run over all pixels in order on every core, and each core adds to rows of texels of its own;
all others run over rows of texels, and sums over rows are added in order. The result does not depend on the number of
threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles, f32
from nerfbake.kernels.jit import compiled, part_of
from nerfbake.kernels.parallel import on_every_core

NONE = -1
_BLOCK = 16  # rows of texels that one core adds to


class Lookups(NamedTuple):
    """The lookups of p pixels. Those of pixel i are at[starts[i] : starts[i + 1]], at least one."""

    at: Singles  # (r, 2) x and y in texel centres, 0 to edge - 1
    starts: npt.NDArray[np.int32]  # (p + 1,)


def gather(
    triangle: npt.NDArray[np.int32],
    weights: Singles,
    faces: npt.NDArray[np.uint32],
    places: Singles,
    finer: int,
) -> tuple[Lookups, Ints]:
    """The lookups of a picture, and the pixels (p,) that have any, in order.

    triangle (H N, W N) and weights (H N, W N, 3) of finer x finer = N x N rays a pixel, as gbuffer() returns them;
    places (v, 2) of the vertices in texel centres.
    """
    H, W = (edge // finer for edge in triangle.shape)
    hits = (triangle != NONE).reshape(H, finer, W, finer).sum(axis=(1, 3), dtype=np.int32).reshape(-1)
    pixels = np.flatnonzero(hits)
    starts = np.concatenate([[0], np.cumsum(hits[pixels])]).astype(np.int32)
    at = np.empty((starts[-1], 2), np.float32)
    _gather(triangle, weights, faces, places, finer, pixels, starts, at)
    return Lookups(at, starts), pixels


@on_every_core
@compiled()
def _gather(
    core: int,
    cores: int,
    triangle: npt.NDArray[np.int32],
    weights: Singles,
    faces: npt.NDArray[np.uint32],
    places: Singles,
    finer: int,
    pixels: Ints,
    starts: npt.NDArray[np.int32],
    at: Singles,
) -> None:
    W = triangle.shape[1] // finer
    begin, end = part_of(len(pixels), core, cores)
    for i in range(begin, end):
        entry = starts[i]
        top, left = pixels[i] // W * finer, pixels[i] % W * finer
        for y in range(top, top + finer):
            for x in range(left, left + finer):
                f = triangle[y, x]
                if f != NONE:
                    for axis in range(2):
                        at[entry, axis] = (
                            weights[y, x, 0] * places[faces[f, 0], axis]
                            + weights[y, x, 1] * places[faces[f, 1], axis]
                            + weights[y, x, 2] * places[faces[f, 2], axis]
                        )
                    entry += 1


@on_every_core
@compiled()
def residuals(
    core: int, cores: int, at: Singles, starts: npt.NDArray[np.int32], texels: Singles, targets: Singles, out: Singles
) -> None:
    """Fill (p, 3): the target of each pixel minus the mean of its lookups in texels (H, W, 3)."""
    H, W, _ = texels.shape
    begin, end = part_of(len(targets), core, cores)
    for i in range(begin, end):
        r, g, b = f32(0), f32(0), f32(0)
        for entry in range(starts[i], starts[i + 1]):
            x, y = min(int(at[entry, 0]), W - 2), min(int(at[entry, 1]), H - 2)
            fx, fy = at[entry, 0] - f32(x), at[entry, 1] - f32(y)
            gx, gy = f32(1) - fx, f32(1) - fy
            a, b0, c, d = gx * gy, fx * gy, gx * fy, fx * fy
            r += a * texels[y, x, 0] + b0 * texels[y, x + 1, 0] + c * texels[y + 1, x, 0] + d * texels[y + 1, x + 1, 0]
            g += a * texels[y, x, 1] + b0 * texels[y, x + 1, 1] + c * texels[y + 1, x, 1] + d * texels[y + 1, x + 1, 1]
            b += a * texels[y, x, 2] + b0 * texels[y, x + 1, 2] + c * texels[y + 1, x, 2] + d * texels[y + 1, x + 1, 2]
        share = f32(1) / f32(starts[i + 1] - starts[i])
        out[i, 0], out[i, 1] = targets[i, 0] - share * r, targets[i, 1] - share * g
        out[i, 2] = targets[i, 2] - share * b


@compiled()
def _own_rows(core: int, cores: int, H: int) -> Bits:
    """(H,) the rows of texels that a core adds to: blocks of rows in turn, as charts leave parts of a texture empty."""
    own = np.zeros(H, np.bool_)
    for y in range(H):
        own[y] = y // _BLOCK % cores == core
    return own


@on_every_core
@compiled()
def spread(
    core: int,
    cores: int,
    at: Singles,
    starts: npt.NDArray[np.int32],
    weights: Singles,
    values: Singles,
    out: Singles,
) -> None:
    """Add the values (p, 3) of each pixel, times its weight, to the texels (H, W, 3) that its lookups read."""
    H, W, _ = out.shape
    own = _own_rows(core, cores, H)
    for i in range(len(values)):
        share = weights[i] / f32(starts[i + 1] - starts[i])
        r, g, b = share * values[i, 0], share * values[i, 1], share * values[i, 2]
        for entry in range(starts[i], starts[i + 1]):
            y = min(int(at[entry, 1]), H - 2)
            if not (own[y] or own[y + 1]):
                continue
            x = min(int(at[entry, 0]), W - 2)
            fx, fy = at[entry, 0] - f32(x), at[entry, 1] - f32(y)
            for dy in range(2):
                if not own[y + dy]:
                    continue
                row = fy if dy else f32(1) - fy
                for dx in range(2):
                    part = row * (fx if dx else f32(1) - fx)
                    out[y + dy, x + dx, 0] += part * r
                    out[y + dy, x + dx, 1] += part * g
                    out[y + dy, x + dx, 2] += part * b


@on_every_core
@compiled()
def couple(core: int, cores: int, at: Singles, starts: npt.NDArray[np.int32], weights: Singles, out: Singles) -> None:
    """Add to (H, W, 5) the coupling of each texel with itself and those right, lower left, below, lower right."""
    H, W, _ = out.shape
    own = _own_rows(core, cores, H)
    for i in range(len(weights)):
        share = weights[i] / f32(starts[i + 1] - starts[i])
        for entry in range(starts[i], starts[i + 1]):
            y = min(int(at[entry, 1]), H - 2)
            if not (own[y] or own[y + 1]):
                continue
            x = min(int(at[entry, 0]), W - 2)
            fx, fy = at[entry, 0] - f32(x), at[entry, 1] - f32(y)
            gx, gy = f32(1) - fx, f32(1) - fy
            a, b, c, d = gx * gy, fx * gy, gx * fy, fx * fy
            sa, sb, sc = share * a, share * b, share * c
            if own[y]:
                out[y, x, 0] += sa * a
                out[y, x, 1] += sa * b
                out[y, x, 3] += sa * c
                out[y, x, 4] += sa * d
                out[y, x + 1, 0] += sb * b
                out[y, x + 1, 2] += sb * c
                out[y, x + 1, 3] += sb * d
            if own[y + 1]:
                out[y + 1, x, 0] += sc * c
                out[y + 1, x, 1] += sc * d
                out[y + 1, x + 1, 0] += share * d * d


@on_every_core
@compiled()
def smooth(core: int, cores: int, used: Bits, strength: float, out: Singles) -> None:
    """Add to (H, W, 5) the coupling that keeps used texels similar to their used neighbours right and below."""
    H, W = used.shape
    s = f32(strength)
    for y in range(core, H, cores):
        for x in range(W):
            if not used[y, x]:
                continue
            if x + 1 < W and used[y, x + 1]:
                out[y, x, 1] -= s
                out[y, x, 0] += s
            if x > 0 and used[y, x - 1]:
                out[y, x, 0] += s
            if y + 1 < H and used[y + 1, x]:
                out[y, x, 3] -= s
                out[y, x, 0] += s
            if y > 0 and used[y - 1, x]:
                out[y, x, 0] += s


def solve(matrix: Singles, right: Singles, used: Bits, steps: int) -> Singles:
    """(H, W, 3): `steps` steps of conjugate gradients from 0, preconditioned by the diagonal.

    matrix (H, W, 5) as couple() and smooth() fill it, right (H, W, 3). Texels that are not used stay 0.
    """
    found, rest = np.zeros_like(right), np.where(used[..., None], right, f32(0))
    along, image = np.zeros_like(right), np.empty_like(right)
    rows = np.zeros(len(right))
    before = 0.0
    for step in range(steps):
        _weigh(matrix, rest, used, rows)
        now = _total(rows)
        if now <= 0:
            break
        _turn(matrix, rest, used, f32(now / before if step else 0), along)
        _multiply(matrix, along, used, image, rows)
        curve = _total(rows)
        if curve <= 0:
            break
        _step(f32(now / curve), along, image, found, rest)
        before = now
    return found


def _total(rows: Floats) -> float:
    return float(np.cumsum(rows)[-1])  # from the first to the last; sum() adds in another order


@on_every_core
@compiled()
def _weigh(core: int, cores: int, matrix: Singles, rest: Singles, used: Bits, rows: Floats) -> None:
    H, W, C = rest.shape
    for y in range(core, H, cores):
        total = 0.0
        for x in range(W):
            if used[y, x] and matrix[y, x, 0] > 0:
                for c in range(C):
                    total += np.float64(rest[y, x, c] * rest[y, x, c] / matrix[y, x, 0])
        rows[y] = total


@on_every_core
@compiled()
def _turn(core: int, cores: int, matrix: Singles, rest: Singles, used: Bits, keep: np.float32, along: Singles) -> None:
    H, W, C = rest.shape
    for y in range(core, H, cores):
        for x in range(W):
            if used[y, x] and matrix[y, x, 0] > 0:
                for c in range(C):
                    along[y, x, c] = rest[y, x, c] / matrix[y, x, 0] + keep * along[y, x, c]


@on_every_core
@compiled()
def _multiply(core: int, cores: int, matrix: Singles, along: Singles, used: Bits, image: Singles, rows: Floats) -> None:
    H, W, C = along.shape
    for y in range(core, H, cores):
        total = 0.0
        for x in range(W):
            if not used[y, x]:
                for c in range(C):
                    image[y, x, c] = 0
                continue
            left, up = max(x - 1, 0), max(y - 1, 0)
            right, down = min(x + 1, W - 1), min(y + 1, H - 1)
            m0, m1, m2, m3, m4 = matrix[y, x, 0], matrix[y, x, 1], matrix[y, x, 2], matrix[y, x, 3], matrix[y, x, 4]
            n1, n2, n3, n4 = f32(0), f32(0), f32(0), f32(0)
            if x > 0:
                n1 = matrix[y, left, 1]
            if y > 0:
                n3 = matrix[up, x, 3]
                if x > 0:
                    n4 = matrix[up, left, 4]
                if x + 1 < W:
                    n2 = matrix[up, right, 2]
            for c in range(C):
                value = m0 * along[y, x, c] + m1 * along[y, right, c] + m2 * along[down, left, c]
                value += m3 * along[down, x, c] + m4 * along[down, right, c]
                value += n1 * along[y, left, c] + n2 * along[up, right, c] + n3 * along[up, x, c]
                value += n4 * along[up, left, c]
                image[y, x, c] = value
                total += np.float64(value * along[y, x, c])
        rows[y] = total


@on_every_core
@compiled()
def _step(
    core: int, cores: int, far: np.float32, along: Singles, image: Singles, found: Singles, rest: Singles
) -> None:
    for y in range(core, len(found), cores):
        for x in range(found.shape[1]):
            for c in range(found.shape[2]):
                found[y, x, c] += far * along[y, x, c]
                rest[y, x, c] -= far * image[y, x, c]


def fill(texels: Singles, known: Bits) -> Singles:
    """(H, W, C): the known texels, and the others blended from those around, from fine to coarse.

    Source: Gortler et al., "The lumigraph" (1996), section 3.4 (pull-push).
    """
    if known.all() or not known.any():
        return np.where(known[..., None], texels, f32(0))
    H, W = known.shape
    size = ((0, H % 2), (0, W % 2))
    held = np.pad(known, size).astype(np.float32)[..., None]
    pairs = np.pad(texels, (*size, (0, 0))) * held
    weight = held[::2, ::2] + held[1::2, ::2] + held[::2, 1::2] + held[1::2, 1::2]
    coarse = pairs[::2, ::2] + pairs[1::2, ::2] + pairs[::2, 1::2] + pairs[1::2, 1::2]
    coarse = fill(coarse / np.maximum(weight, 1), weight[..., 0] > 0)
    return np.where(known[..., None], texels, _finer(_finer(coarse, 0), 1)[:H, :W])


def _finer(coarse: Singles, axis: int) -> Singles:
    """Twice as many values along an axis, interpolated."""
    coarse = np.moveaxis(coarse, axis, 0)
    wide = np.concatenate([coarse[:1], coarse, coarse[-1:]])
    fine = np.empty((2 * len(coarse), *coarse.shape[1:]), np.float32)
    fine[::2], fine[1::2] = f32(0.75) * coarse + f32(0.25) * wide[:-2], f32(0.75) * coarse + f32(0.25) * wide[2:]
    return np.moveaxis(fine, 0, axis)


def roughness(texels: Singles, used: Bits, strength: float) -> Singles:
    """(H, W, 3): `strength` times the sum of the differences of used neighbours from each used texel.

    The negative gradient of the term that smooth() adds.
    """
    out = np.zeros_like(texels)
    _roughness(texels, used, f32(strength), out)
    return out


@on_every_core
@compiled()
def _roughness(core: int, cores: int, texels: Singles, used: Bits, strength: np.float32, out: Singles) -> None:
    H, W, C = texels.shape
    for y in range(core, H, cores):
        for x in range(W):
            if not used[y, x]:
                continue
            for c in range(C):
                here, total = texels[y, x, c], f32(0)
                if x > 0 and used[y, x - 1]:
                    total += texels[y, x - 1, c] - here
                if x + 1 < W and used[y, x + 1]:
                    total += texels[y, x + 1, c] - here
                if y > 0 and used[y - 1, x]:
                    total += texels[y - 1, x, c] - here
                if y + 1 < H and used[y + 1, x]:
                    total += texels[y + 1, x, c] - here
                out[y, x, c] = strength * total
