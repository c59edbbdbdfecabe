"""Multilayer perceptrons for many points at once.

Lanes are points: every loop over lanes is vectorised, and every sum has one order, so that all CPUs return the same
bits. A pass of the inner loop adds four inputs to two outputs: 70 GFLOP/s on one core, where one output a pass has 36.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Ints, Singles, as_input, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

LANES = 64  # points at a time


class PackedLayers(NamedTuple):
    """The layers of a perceptron as two arrays.

    numbers  weights and biases, layer after layer; each layer has an even number of outputs
    table    (l, 6): outputs, inputs, the places of the first weight and of the first bias, 1 if the layer also takes
             the perceptron's inputs after the outputs of the layer before, 1 if ReLU follows
    """

    numbers: Singles
    table: Ints


def pack_layers(
    weights: tuple[Singles, ...], biases: tuple[Singles, ...], skips: tuple[int, ...], rectified: bool
) -> PackedLayers:
    """Pack weights (..., out, in) and biases (..., out): numbers (..., size). Axes in front are perceptrons.

    skips: layers that also take the perceptron's inputs. rectified: ReLU also follows the last layer. An odd number of
    outputs is filled up with a zero output, for which the next layer has a zero weight.
    """
    numbers, table, at = [], [], 0
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if k and (before := weights[k - 1].shape[-2]) % 2:  # the zero output of the layer before
            weight = np.insert(weight, before, 0, axis=-1)
        front, extra = [(0, 0)] * (bias.ndim - 1), bias.shape[-1] % 2
        weight, bias = np.pad(weight, [*front, (0, extra), (0, 0)]), np.pad(bias, [*front, (0, extra)])
        flat = weight.reshape(*bias.shape[:-1], -1)
        numbers += [flat, bias]
        size = at + flat.shape[-1]
        table.append([*weight.shape[-2:], at, size, k in skips, rectified or k + 1 < len(weights)])
        at = size + bias.shape[-1]
    joined = np.concatenate(numbers, axis=-1).astype(np.float32)
    return PackedLayers(as_input(joined), as_input(np.array(table, np.int64)))


def run_mlp(packed: PackedLayers, inputs: Singles, outputs: int) -> Singles:
    """(outputs, m) results of a perceptron for (in, m) inputs."""
    out = np.empty((outputs, inputs.shape[1]), np.float32)
    _run(packed, as_input(inputs), out)
    return out


@compiled()
def add_product(numbers: Singles, start: int, columns: int, first: int, x: Singles, count: int, y: Singles) -> None:
    """y += weights @ x, for rows of y in pairs. weights (len(y), columns) are numbers[start:], from column `first` on.

    x (count, lanes), y (an even number, lanes).
    """
    fours = count - count % 4
    for o in range(0, len(y), 2):
        a, b = start + o * columns + first, start + (o + 1) * columns + first
        for i in range(0, fours, 4):
            a0, a1, a2, a3 = numbers[a + i], numbers[a + i + 1], numbers[a + i + 2], numbers[a + i + 3]
            b0, b1, b2, b3 = numbers[b + i], numbers[b + i + 1], numbers[b + i + 2], numbers[b + i + 3]
            for lane in range(LANES):
                x0, x1, x2, x3 = x[i, lane], x[i + 1, lane], x[i + 2, lane], x[i + 3, lane]
                y[o, lane] += (a0 * x0 + a1 * x1) + (a2 * x2 + a3 * x3)
                y[o + 1, lane] += (b0 * x0 + b1 * x1) + (b2 * x2 + b3 * x3)
        for i in range(fours, count):
            wa, wb = numbers[a + i], numbers[b + i]
            for lane in range(LANES):
                y[o, lane] += wa * x[i, lane]
                y[o + 1, lane] += wb * x[i, lane]


@compiled()
def run_layer(packed: PackedLayers, layer: int, x: Singles, count: int, inputs: Singles, y: Singles) -> None:
    """Compute the outputs y (outputs, lanes) of a layer from the `count` first rows of x, and from the inputs."""
    numbers = packed.numbers
    columns, start, bias = packed.table[layer, 1], packed.table[layer, 2], packed.table[layer, 3]
    for o in range(len(y)):
        y[o] = numbers[bias + o]
    add_product(numbers, start, columns, 0, x, count, y)
    if packed.table[layer, 4]:
        add_product(numbers, start, columns, count, inputs, len(inputs), y)
    if packed.table[layer, 5]:
        for o in range(len(y)):
            for lane in range(LANES):
                y[o, lane] = max(y[o, lane], f32(0))


@compiled()
def scratch(table: Ints, inputs: int) -> tuple[Singles, Singles, Singles]:
    """The buffers of run_block(), for layers of this table and a number of inputs."""
    widest = table[:, 0].max()
    given = np.zeros((inputs, LANES), np.float32)
    return given, np.empty((widest, LANES), np.float32), np.empty((widest, LANES), np.float32)


@compiled()
def run_block(
    packed: PackedLayers, inputs: Singles, begin: int, end: int, buffers: tuple[Singles, Singles, Singles], out: Singles
) -> None:
    """Compute the points begin .. end of inputs (in, m), at most LANES, into out (outputs, m)."""
    table, (given, one, other) = packed.table, buffers
    for i in range(len(inputs)):
        for lane in range(end - begin):
            given[i, lane] = inputs[i, begin + lane]
    run_layer(packed, 0, given, len(inputs), given, one[: table[0, 0]])
    for layer in range(1, len(table)):
        run_layer(packed, layer, one, table[layer - 1, 0], given, other[: table[layer, 0]])
        one, other = other, one
    for o in range(len(out)):
        for lane in range(end - begin):
            out[o, begin + lane] = one[o, lane]


@on_every_core
@compiled()
def _run(core: int, cores: int, packed: PackedLayers, inputs: Singles, out: Singles) -> None:
    m, buffers = inputs.shape[1], scratch(packed.table, len(inputs))
    for block in range(core, (m + LANES - 1) // LANES, cores):
        run_block(packed, inputs, block * LANES, min((block + 1) * LANES, m), buffers, out)
