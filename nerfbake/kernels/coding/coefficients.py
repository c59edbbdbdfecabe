"""Coefficients, coded row by row and channel by channel: is it zero, its sign, its size.

What is known of channel k of a row when it is its turn: its neighbours' values n0 .. n3 (those of the row's four
references, 0 without one; within +-255, as is every value that others are judged by), and of the channels before it

    recent   2 |v1| + |v2| + |v3|, those of the three before it, 40 each at most
    run      the sum of all before it, 20 each at most
    dot_i    the sum of value * n_i       energy  the sum of all n_i^2

If a neighbour has gone the same way so far, or the opposite way, it is likely to go on so:

    guess    the sum of dot_i * n_i       match   the bucket of 8 |guess| / (energy + 1)

Channels of colour from the tenth on come in groups of six, which are skipped where all of them are zero. Streams split
the channels, so that several cores may decode: each knows all that is in the streams before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.coding.pairs import AXES, REFERENCES, Pairs
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
    learnt,
    mix_bit,
    mixer,
)
from nerfbake.kernels.coding.range_coder import Models as Bits
from nerfbake.kernels.coding.tables import MATCH_BUCKETS, MATCHES, SIZE_BUCKETS, SIZES
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import in_relay

Values = npt.NDArray[np.int32]
Numbers = npt.NDArray[np.int64]

CLIP, LONG, SHORT = 255, 20, 40  # how large a value may count
FIRST_GROUP, GROUP = 9, 6  # channels
SINGLE = 8  # sizes up to this have a decision each; above, each decision doubles the interval
STEPS = 16  # decisions of a size that have models of their own; further ones share the last's
MOST_STEPS = SINGLE + 29  # sizes are below 2^30
_SHARES = np.array([0, 12, 6, 4, 3])  # 12 / how many references there are
_SIGNS = 81  # of four neighbours
_MATCHES = 2 * MATCH_BUCKETS  # with its sign
_CHUNK = 1 << 13  # rows
SOUND, TOO_LARGE, TOO_SHORT = range(3)  # what may be wrong with what is decoded


class Models(NamedTuple):
    """groups, zeros, signs, sizes: for each kind of decision; bits: of the first bit behind a size's interval."""

    groups: Mixer
    zeros: Mixer
    signs: Mixer
    sizes: Mixer
    bits: Bits


class Row(NamedTuple):
    """What is kept while a row is coded: near (C, 4) neighbours' values, dots (4,)."""

    near: Numbers
    dots: Numbers


def encode_values(values: Values, pairs: Pairs, ends: Sequence[int]) -> list[Bytes]:
    """A stream for each run of channels; ends: where each of them ends, rising, the last is all. Row 0 is left out."""
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


def decode_values(streams: Sequence[Bytes], values: Values, pairs: Pairs, ends: Sequence[int]) -> tuple[int, list[int]]:
    """Fills rows 1 .. of values; what is wrong with them, and how many bytes each stream took."""
    coders = {i: decoder(stream) for i, stream in enumerate(streams)}
    found = _code_all(values, pairs, ends, coders)
    return found, [consumed(coder) for coder in coders.values()]


def _code_all(values: Values, pairs: Pairs, ends: Sequence[int], coders: dict[int, Coder]) -> int:
    starts, wrong = [0, *ends[:-1]], [SOUND] * len(ends)
    models = {i: _models_of(values.shape[1]) for i in coders}
    room = {i: Row(np.zeros((values.shape[1], REFERENCES), np.int64), np.zeros(REFERENCES, np.int64)) for i in coders}

    def work(runner: int, begin: int, end: int) -> None:
        i = order[runner]
        if max(wrong) == SOUND:
            rows = slice(max(begin, 1), end)
            wrong[i] = _code(values, pairs, starts[i], ends[i], rows.start, rows.stop, coders[i], models[i], room[i])

    order = sorted(coders)
    in_relay(work, len(order), len(values), _CHUNK)
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
@compiled(inline=True)
def _size_bucket(value: int) -> Any:
    return SIZES[min(value, len(SIZES) - 1)]


@compiled(inline=True)
def _sign(value: int) -> int:
    """0, 1, 2 for below, at and above zero."""
    return 1 + (value > 0) - (value < 0)


@compiled()
def _code(
    values: Values, pairs: Pairs, first: int, last: int, begin: int, end: int, coder: Coder, models: Models, own: Row
) -> int:
    """Codes or decodes channels first .. last - 1 of some rows."""
    C = values.shape[1]
    near, dots = own
    for row in range(begin, end):
        count = _look_around(values, pairs.references[row], last, own)
        axis, energy, run, v1, v2, v3, skipped = AXES[pairs.slot[row]], 0, 0, 0, 0, 0, 0
        for k in range(last):
            value, n = values[row, k], near[k]
            if k >= first:
                recent, total = (
                    _size_bucket(2 * min(abs(v1), SHORT) + min(abs(v2), SHORT) + min(abs(v3), SHORT)),
                    _size_bucket(run),
                )
                if FIRST_GROUP <= k < C - 1 and (k - FIRST_GROUP) % GROUP == 0:
                    skipped = _skip(
                        values[row, :last],
                        near,
                        k,
                        min(k + GROUP, last, C - 1),
                        recent,
                        total,
                        count,
                        pairs.slot[row],
                        coder,
                        models.groups,
                    )
                value = (
                    0
                    if k < skipped
                    else _code_value(value, k, n, count, recent, total, dots, energy, v1, v2, axis, coder, models)
                )
                if value >> 30 == 1:
                    return TOO_LARGE
                if coder.state[DECODES]:
                    values[row, k] = value
            seen = min(max(value, -CLIP), CLIP)
            for i in range(REFERENCES):
                dots[i] += seen * n[i]
                energy += n[i] * n[i]
            v1, v2, v3 = value, v1, v2
            run += min(abs(value), LONG)
        if coder.state[DECODES] and coder.state[PLACE] > len(coder.data) + 3:
            return TOO_SHORT
    return SOUND


@compiled(inline=True)
def _look_around(values: Values, references: Values, last: int, own: Row) -> int:
    """Collects the neighbours' values; how many references there are."""
    near, dots = own
    count = 0
    for i in range(REFERENCES):
        dots[i] = 0
        count += references[i] != 0
        for k in range(last):
            near[k, i] = min(max(values[references[i], k], -CLIP), CLIP) if references[i] else 0
    return count


@compiled(inline=True)
def _skip(
    row: Values,
    near: Numbers,
    k: int,
    stop: int,
    recent: int,
    total: int,
    count: int,
    slot: int,
    coder: Coder,
    mixer: Mixer,
) -> int:
    """Codes whether the group of channels k .. stop - 1 has anything; before which channel nothing is coded."""
    group, some, found = (k - FIRST_GROUP) // GROUP, 0, 0
    for channel in range(k, stop):
        some |= row[channel] != 0
        for i in range(REFERENCES):
            found += min(abs(near[channel, i]), 3)
    around = _size_bucket(found * _SHARES[count] // 6)
    a = (group * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total
    b = (group * SIZE_BUCKETS + around) * SIZE_BUCKETS + total
    c = (around * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total
    d = (group * SIZE_BUCKETS + around) * 8 + slot
    return k if mix_bit(coder, mixer, group, a, b, c, d, some) else stop


@compiled(inline=True)
def _code_value(
    value: int, k: int, n: Numbers, count: int, recent: int, total: int, dots: Numbers, energy: int,
    v1: int, v2: int, axis: int, coder: Coder, models: Models,
) -> int:  # fmt: skip
    """Codes or decodes a value; 2^30 if it is too large."""
    beside = abs(n[0]) + abs(n[1]) + abs(n[2])
    guess = dots[0] * n[0] + dots[1] * n[1] + dots[2] * n[2] + dots[3] * n[3]
    around = _size_bucket((beside + abs(n[3])) * _SHARES[count] // 3)
    match = MATCHES[min(8 * abs(guess) // (energy + 1), len(MATCHES) - 1)] if guess else 0
    a = (k * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total
    b = (k * SIZE_BUCKETS + _size_bucket(2 * beside)) * SIZE_BUCKETS + _size_bucket(2 * abs(n[3]))
    c = (around * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total
    d = (k * MATCH_BUCKETS + match) * SIZE_BUCKETS + around
    if not mix_bit(coder, models.zeros, k, a, b, c, d, value != 0):
        return 0
    signs, above = ((_sign(n[0]) * 3 + _sign(n[1])) * 3 + _sign(n[2])) * 3 + _sign(n[3]), _sign(n[3])
    way = MATCH_BUCKETS + match if guess > 0 else MATCH_BUCKETS - match
    s1, s2 = ((k * 3 + _sign(v1)) * 3 + _sign(v2)) * _MATCHES + way, ((k * 3 + above) * 3 + axis) * _MATCHES + way
    negative = mix_bit(coder, models.signs, k, signs * len(models.bits) + k, s1, way * _SIGNS + signs, s2, value < 0)
    fits = 0 if guess == 0 else match if (guess < 0) == (negative == 1) else -match
    d = (k * _MATCHES + MATCH_BUCKETS + fits) * SIZE_BUCKETS + around
    size = _code_size(abs(value), k, a, b, c, d, coder, models)
    return -size if negative and size >> 30 == 0 else size


@compiled(inline=True)
def _code_size(size: int, k: int, a: int, b: int, c: int, d: int, coder: Coder, models: Models) -> int:
    """Codes or decodes a size above 0: is it more than 1, 2, ..., 8, 10, 14, 22, ...? Then its place among as many."""
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
            models.bits[k, step] = learnt(model, bit)
        else:
            bit = code_bit(coder, 1 << 15, bit)
        found = 2 * found + bit
    return found + SINGLE - 1
