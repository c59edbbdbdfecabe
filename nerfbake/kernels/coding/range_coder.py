"""A binary range coder with probabilities mixed from several adaptive models, in integer arithmetic only.

Decisions are bits, each with a probability p of being 1, in 1/65536. The coder keeps an interval of 32 bits:

    range   2^24 .. 2^32 - 1     bound = range * p >> 16
    1       takes the lower part: range = bound
    0       takes the upper part: low += bound, range -= bound
    while range < 2^24           a byte is shifted out of low (into code, when decoding), range <<= 8

A model is one number, p << 8 | n: a probability in 1/2^22 and a count n of outcomes. Each outcome moves it by
1 / (n + 1.5) of its error, n at most 250. A decision uses several models, selected by its contexts. Their probabilities
are mixed in the logistic domain with weights in 1/65536, which adapt as well:

    x = sum of weight * stretch(p) >> 16, within +-2047      p = squash(x)
    error = (65535 or 0) - p                                 weight += stretch(p) * error * 3 + 2^15 >> 16

The same function encodes and decodes, so both compute the same numbers. Sources: G. N. N. Martin, "Range encoding",
1979; M. Mahoney, "Adaptive weighing of context models for lossless data compression", 2005.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.coding.tables import LIMIT, RATES, SQUASH, STRETCH
from nerfbake.kernels.jit import compiled

Bytes = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.int64]
Models = npt.NDArray[np.int32]

DECODES, LOW, RANGE, PLACE = range(4)  # indices of a coder's state; LOW is the code when decoding
EVEN = 1 << 29  # the initial model: p = 1/2, n = 0
START = 4  # bytes that a decoder reads before the first decision
AHEAD = 3  # bytes that a decoder is ahead of the encoder's last byte
KINDS = 4  # models for each decision
WEIGHT = 19661  # initial weight of each model: 0.3
RATE = 3  # learning rate of the weights


class Coder(NamedTuple):
    """state (4,), and data: the bytes to decode, or a buffer for the encoded bytes."""

    state: Numbers
    data: Bytes


class Mixer(NamedTuple):
    """models (4, values): for each kind of context the models of all its values; weights (sets, 4)."""

    models: Models
    weights: Numbers


def encoder(room: int) -> Coder:
    """A coder that writes at most this number of bytes, including those of finish()."""
    return Coder(np.array([0, 0, (1 << 32) - 1, 0]), np.zeros(room + 1, np.uint8))


def decoder(data: Bytes) -> Coder:
    """A coder that reads these bytes, followed by zeros."""
    code = int.from_bytes(bytes(data[:START]).ljust(START, b"\0"), "big")
    return Coder(np.array([1, code, (1 << 32) - 1, START]), data.copy())  # numba compiles read-only arrays separately


def mixer(values: int, sets: int) -> Mixer:
    """Models for four kinds of contexts with this number of values each, and this number of weight sets."""
    return Mixer(np.full((KINDS, values), EVEN, np.int32), np.full((sets, KINDS), WEIGHT))


@compiled(merged=True)
def code_bit(coder: Coder, p: int, bit: int) -> Any:
    """Encode this bit, or decode and return one, depending on the coder.

    p: probability of a 1 in 1/65536, neither 0 nor 65536.
    """
    low, width = coder.state[LOW], coder.state[RANGE]
    bound = width * p >> 16
    if coder.state[DECODES]:
        bit = 1 if low < bound else 0
    if bit:
        width = bound
    else:
        width -= bound
        if coder.state[DECODES]:
            low -= bound
        else:
            low += bound
            if low >> 32:
                low &= 0xFFFFFFFF
                _carry(coder)
    while width < 1 << 24:
        place = coder.state[PLACE]
        if coder.state[DECODES]:
            low = low << 8 | (coder.data[place] if place < len(coder.data) else 0)
        else:
            if place < len(coder.data):
                coder.data[place] = low >> 24
            low = (low & 0xFFFFFF) << 8
        coder.state[PLACE] = place + 1
        width <<= 8
    coder.state[LOW], coder.state[RANGE] = low, width
    return bit


@compiled(merged=True)
def _carry(coder: Coder) -> None:
    """Add 1 to the bytes written so far."""
    place = min(coder.state[PLACE], len(coder.data)) - 1
    while coder.data[place] == 255:
        coder.data[place] = 0
        place -= 1
    coder.data[place] += 1


@compiled(merged=True)
def mix_bit(coder: Coder, mixer: Mixer, own: int, a: int, b: int, c: int, d: int, bit: int) -> Any:
    """Encode or decode a bit with model a of the first kind, b of the second, c and d, and weight set `own`."""
    m0, m1, m2, m3 = mixer.models[0, a], mixer.models[1, b], mixer.models[2, c], mixer.models[3, d]
    w0, w1, w2, w3 = mixer.weights[own, 0], mixer.weights[own, 1], mixer.weights[own, 2], mixer.weights[own, 3]
    x0, x1 = int(STRETCH[m0 >> 18]), int(STRETCH[m1 >> 18])
    x2, x3 = int(STRETCH[m2 >> 18]), int(STRETCH[m3 >> 18])
    x = w0 * x0 + w1 * x1 + w2 * x2 + w3 * x3 >> 16
    p = int(SQUASH[min(max(x, -2047), 2047) + 2048])
    bit = code_bit(coder, p, bit)
    error = (65535 * bit - p) * RATE
    mixer.weights[own, 0] = w0 + (x0 * error + (1 << 15) >> 16)
    mixer.weights[own, 1] = w1 + (x1 * error + (1 << 15) >> 16)
    mixer.weights[own, 2] = w2 + (x2 * error + (1 << 15) >> 16)
    mixer.weights[own, 3] = w3 + (x3 * error + (1 << 15) >> 16)
    mixer.models[0, a], mixer.models[1, b] = updated_model(m0, bit), updated_model(m1, bit)
    mixer.models[2, c], mixer.models[3, d] = updated_model(m2, bit), updated_model(m3, bit)
    return bit


@compiled(merged=True)
def updated_model(model: int, bit: int) -> Any:
    """The model after an outcome."""
    p, n = model >> 8, model & 255
    p += (bit * ((1 << 22) - 1) - p) * RATES[n] >> 16
    return p << 8 | min(n + 1, LIMIT)


@compiled()
def finish(coder: Coder) -> Any:
    """Finish encoding. Returns the number of bytes, which may exceed the size of the buffer."""
    state, data = coder
    state[LOW] += 0xFFFFFF
    if state[LOW] >> 32:
        state[LOW] &= 0xFFFFFFFF
        _carry(coder)
    if state[PLACE] < len(data):
        data[state[PLACE]] = state[LOW] >> 24
    return state[PLACE] + 1


def consumed(coder: Coder) -> int:
    """Number of bytes that the encoder wrote for the decoded bits; more than the data has if it is truncated."""
    return int(coder.state[PLACE]) - AHEAD
