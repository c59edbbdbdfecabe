"""Coding of coefficients, row by row and channel by channel: a zero flag, the sign, and the size.

The context of channel k of a row is computed from the values n0 .. n3 of its neighbours (the row's four references; 0
without a reference; clamped to +-255, like every value that enters a context), and from the channels before it:

    recent   2 |v1| + |v2| + |v3|, those of the three before it, 40 each at most
    run      the sum of all before it, 20 each at most
    dot_i    the sum of value * n_i       energy  the sum of all n_i^2

If a neighbour has varied in the same direction so far, or in the opposite direction, it is likely to continue:

    guess    the sum of dot_i * n_i       match   the bucket of 8 |guess| / (energy + 1)

Channels of colour from the tenth on are coded in groups of six. A group is skipped if all its channels are zero.
Streams split the channels, so several cores can decode: each stream uses the values of all streams before it as
context.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.coding.pairs import AXES, REFERENCES, CoefficientPairs
from nerfbake.kernels.coding.range_coder import (
    DECODES,
    EVEN,
    PLACE,
    Bytes,
    Coder,
    Mixer,
    code_bit,
    consumed,
    decoder,
    encoder,
    finish,
    mix_bit,
    mixer,
    updated_model,
)
from nerfbake.kernels.coding.range_coder import Models as Bits
from nerfbake.kernels.coding.tables import MATCH_BUCKETS, MATCHES, SIZE_BUCKETS, SIZES
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import run_in_turn

Values = npt.NDArray[np.int32]
Numbers = npt.NDArray[np.int64]

CLIP, LONG, SHORT = 255, 20, 40  # limits of the values that enter a context
FIRST_GROUP, GROUP = 9, 6  # channels
SINGLE = 8  # sizes up to this have one decision each; above, each decision doubles the interval
STEPS = 16  # decisions of a size with separate models; further ones share the last models
MOST_STEPS = SINGLE + 29  # sizes are below 2^30
_SHARES = np.array([0, 12, 6, 4, 3])  # 12 / the number of references
_SIGNS = 81  # of four neighbours
_MATCHES = 2 * MATCH_BUCKETS  # with its sign
_CHUNK = 1 << 13  # rows
SOUND, TOO_LARGE, TOO_SHORT = range(3)  # status of decoded values


class Models(NamedTuple):
    """Models of all decisions.

    groups, zeros, signs, sizes: a mixer for each kind of decision. bits: models of the first bit within a size's
    interval.
    """

    groups: Mixer
    zeros: Mixer
    signs: Mixer
    sizes: Mixer
    bits: Bits


def encode_values(values: Values, pairs: CoefficientPairs, ends: Sequence[int]) -> list[Bytes]:
    """Return one stream for each run of channels. Row 0 is not coded.

    ends: where each run of channels ends, ascending; the last is the number of channels.
    """
    values = np.require(values, requirements=["C", "W"])
    streams, rooms = [np.zeros(0, np.uint8)] * len(ends), [values.size // 4 + 4096] * len(ends)
    while missing := [i for i, room in enumerate(rooms) if room]:
        coders = {i: encoder(rooms[i]) for i in missing}
        _code_all(values, pairs, ends, coders)
        for i, coder in coders.items():
            size = finish(coder)
            streams[i] = coder.data[:size]
            rooms[i] = size if size > rooms[i] else 0
    return streams


def decode_values(
    streams: Sequence[Bytes], values: Values, pairs: CoefficientPairs, ends: Sequence[int]
) -> tuple[int, list[int]]:
    """Fill rows 1 .. of values.

    Returns the status (SOUND, TOO_LARGE or TOO_SHORT) and the number of bytes read from each stream.
    """
    coders = {i: decoder(stream) for i, stream in enumerate(streams)}
    found = _code_all(values, pairs, ends, coders)
    return found, [consumed(coder) for coder in coders.values()]


def _code_all(values: Values, pairs: CoefficientPairs, ends: Sequence[int], coders: dict[int, Coder]) -> int:
    starts, wrong = [0, *ends[:-1]], [SOUND] * len(ends)
    models = {i: _models_of(values.shape[1]) for i in coders}
    near = {i: np.zeros((REFERENCES, values.shape[1]), np.int64) for i in coders}

    def work(runner: int, begin: int, end: int) -> None:
        i = order[runner]
        if max(wrong) == SOUND:
            rows = slice(max(begin, 1), end)
            wrong[i] = _code(values, pairs, starts[i], ends[i], rows.start, rows.stop, coders[i], models[i], near[i])

    order = sorted(coders)
    run_in_turn(work, len(order), len(values), _CHUNK)
    return max(wrong)


def _models_of(C: int) -> Models:
    groups, sizes = C // GROUP + 1, SIZE_BUCKETS**2
    return Models(
        mixer(max(groups, SIZE_BUCKETS) * sizes, groups),
        mixer(max(C, SIZE_BUCKETS) * sizes, C),
        mixer(max(C * 9 * _MATCHES, C * _SIGNS, _MATCHES * _SIGNS), C),
        mixer(max(C * _MATCHES * SIZE_BUCKETS, SIZE_BUCKETS * sizes) * STEPS, C * STEPS),
        np.full((C, MOST_STEPS + 1), EVEN, np.int32),
    )


# -- compiled --------------------------------------------------------------------------------------------------
@compiled(merged=True)
def _bucket(value: int) -> Any:
    return int(SIZES[min(value, len(SIZES) - 1)])


@compiled(merged=True)
def _sign(value: int) -> int:
    """0, 1, 2 for a value below, at and above zero."""
    return 1 + (value > 0) - (value < 0)


@compiled()
def _code(
    values: Values,
    pairs: CoefficientPairs,
    first: int,
    last: int,
    begin: int,
    end: int,
    coder: Coder,
    models: Models,
    near: Numbers,
) -> int:
    """Encode or decode channels first .. last - 1 of rows begin .. end - 1.

    near (4, C): a buffer for the values of the neighbours. Returns SOUND, TOO_LARGE or TOO_SHORT.
    """
    C, columns = values.shape[1], len(models.bits)
    for row in range(begin, end):
        count = _look_around(values, pairs, row, last, near)
        slot, energy, run, v1, v2, v3, skipped = pairs.slot[row], 0, 0, 0, 0, 0, 0
        dot0 = dot1 = dot2 = dot3 = 0
        for k in range(last):
            value, n0, n1, n2, n3 = int(values[row, k]), near[0, k], near[1, k], near[2, k], near[3, k]
            if k >= first:
                recent = _bucket(2 * min(abs(v1), SHORT) + min(abs(v2), SHORT) + min(abs(v3), SHORT))
                total = _bucket(run)
                if FIRST_GROUP <= k < C - 1 and (k - FIRST_GROUP) % GROUP == 0:
                    stop = min(k + GROUP, last, C - 1)
                    some, found = _group(values, row, near, k, stop)
                    group, around = (k - FIRST_GROUP) // GROUP, _bucket(found * _SHARES[count] // 6)
                    a, b, c, d = _group_contexts(group, recent, total, around, slot)
                    skipped = k if mix_bit(coder, models.groups, group, a, b, c, d, some) else stop
                guess = dot0 * n0 + dot1 * n1 + dot2 * n2 + dot3 * n3
                match = int(MATCHES[min(8 * abs(guess) // (energy + 1), len(MATCHES) - 1)]) if guess else 0
                way = match if guess > 0 else -match
                around = _bucket((abs(n0) + abs(n1) + abs(n2) + abs(n3)) * _SHARES[count] // 3)
                a, b, c, d = _zero_contexts(k, recent, total, around, match, (n0, n1, n2, n3))
                if k < skipped or not mix_bit(coder, models.zeros, k, a, b, c, d, value != 0):
                    value = 0
                else:
                    e, f, g, h = _sign_contexts(k, v1, v2, (n0, n1, n2, n3), way, AXES[slot], columns)
                    negative = mix_bit(coder, models.signs, k, e, f, g, h, value < 0)
                    d = _size_context(k, -way if negative else way, around)
                    value = _code_size(abs(value), k, a, b, c, d, coder, models)
                    if value >> 30:
                        return TOO_LARGE
                    value = -value if negative else value
                if coder.state[DECODES]:
                    values[row, k] = value
            seen = min(max(value, -CLIP), CLIP)
            dot0, dot1, dot2, dot3 = dot0 + seen * n0, dot1 + seen * n1, dot2 + seen * n2, dot3 + seen * n3
            energy += n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3
            v1, v2, v3 = value, v1, v2
            run += min(abs(value), LONG)
        if coder.state[DECODES] and coder.state[PLACE] > len(coder.data) + 3:
            return TOO_SHORT
    return SOUND


@compiled(merged=True)
def _look_around(values: Values, pairs: CoefficientPairs, row: int, last: int, near: Numbers) -> int:
    """Collect the values of the neighbours. Returns the number of references."""
    count = 0
    for i in range(REFERENCES):
        reference = pairs.references[row, i]
        if reference:
            count += 1
            for k in range(last):
                near[i, k] = min(max(values[reference, k], -CLIP), CLIP)
        else:
            for k in range(last):
                near[i, k] = 0
    return count


@compiled(merged=True)
def _group(values: Values, row: int, near: Numbers, begin: int, end: int) -> tuple[int, int]:
    """Return whether the row has a nonzero value in a group of channels, and the sum of its neighbours' sizes there.

    The first is meaningful only when encoding. Sizes count 3 each at most.
    """
    some, found = 0, 0
    for k in range(begin, end):
        some |= values[row, k] != 0
        for i in range(REFERENCES):
            found += min(abs(near[i, k]), 3)
    return some, found


Contexts = tuple[int, int, int, int]


@compiled(merged=True)
def _group_contexts(group: int, recent: int, total: int, around: int, slot: int) -> Contexts:
    return (
        (group * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total,
        (group * SIZE_BUCKETS + around) * SIZE_BUCKETS + total,
        (around * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total,
        (group * SIZE_BUCKETS + around) * 8 + slot,
    )


@compiled(merged=True)
def _zero_contexts(k: int, recent: int, total: int, around: int, match: int, n: Contexts) -> Contexts:
    """n: the neighbours' values."""
    return (
        (k * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total,
        (k * SIZE_BUCKETS + _bucket(2 * (abs(n[0]) + abs(n[1]) + abs(n[2])))) * SIZE_BUCKETS + _bucket(2 * abs(n[3])),
        (around * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total,
        (k * MATCH_BUCKETS + match) * SIZE_BUCKETS + around,
    )


@compiled(merged=True)
def _sign_contexts(k: int, v1: int, v2: int, n: Contexts, way: int, axis: int, columns: int) -> Contexts:
    """way: match, negative if the guess is; columns: number of columns of the first table."""
    signs = ((_sign(n[0]) * 3 + _sign(n[1])) * 3 + _sign(n[2])) * 3 + _sign(n[3])
    return (
        signs * columns + k,
        ((k * 3 + _sign(v1)) * 3 + _sign(v2)) * _MATCHES + MATCH_BUCKETS + way,
        (MATCH_BUCKETS + way) * _SIGNS + signs,
        ((k * 3 + _sign(n[3])) * 3 + axis) * _MATCHES + MATCH_BUCKETS + way,
    )


@compiled(merged=True)
def _size_context(k: int, fits: int, around: int) -> int:
    return (k * _MATCHES + MATCH_BUCKETS + fits) * SIZE_BUCKETS + around


@compiled(merged=True)
def _code_size(size: int, k: int, a: int, b: int, c: int, d: int, coder: Coder, models: Models) -> int:
    """Encode or decode a size above 0.

    First the decisions whether it is more than 1, 2, ..., 8, 10, 14, 22, ...; then its place in the interval.
    """
    step = 1
    while step <= MOST_STEPS:
        kind = min(step, STEPS) - 1
        most = step if step < SINGLE else (2 << step - SINGLE) + SINGLE - 2
        if not mix_bit(
            coder,
            models.sizes,
            k * STEPS + kind,
            a * STEPS + kind,
            b * STEPS + kind,
            c * STEPS + kind,
            d * STEPS + kind,
            size > most,
        ):
            break
        step += 1
    if step > MOST_STEPS:
        return 1 << 30
    if step <= SINGLE:
        return step
    place, found = size - SINGLE + 1, 1
    for i in range(step - SINGLE - 1, -1, -1):
        bit = place >> i & 1
        if found == 1:
            model = models.bits[k, step]
            bit = code_bit(coder, min(max(model >> 14, 64), 65536 - 64), bit)
            models.bits[k, step] = updated_model(model, bit)
        else:
            bit = code_bit(coder, 1 << 15, bit)
        found = 2 * found + bit
    return found + SINGLE - 1
