"""Many small perceptrons of equal shape, each for its own points.

Points are sorted by perceptron, so that each perceptron computes its points in lanes, as mlp.py does. A block of fewer
points than lanes takes as long as a full one: 4,096 perceptrons of KiloNeRF take 80 ms at least.
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Ints, Singles, as_input
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.network.mlp import LANES, PackedLayers, run_block, scratch
from nerfbake.kernels.parallel import on_every_core


def run_perceptrons(packed: PackedLayers, which: Ints, inputs: Singles, outputs: int) -> Singles:
    """(outputs, m) results for inputs (in, m), each of the perceptron which (m,). The packed numbers are (n, size)."""
    order = np.argsort(which, kind="stable")
    first = np.searchsorted(which[order], np.arange(len(packed.numbers) + 1)).astype(np.int64)
    out, own = np.empty((outputs, len(which)), np.float32), np.empty((outputs, len(which)), np.float32)
    _run(packed.numbers, packed.table, as_input(first), as_input(inputs[:, order]), own)
    out[:, order] = own
    return out


@on_every_core
@compiled()
def _run(core: int, cores: int, numbers: Singles, table: Ints, first: Ints, inputs: Singles, out: Singles) -> None:
    buffers = scratch(table, len(inputs))
    for which in range(core, len(numbers), cores):
        packed = PackedLayers(numbers[which], table)
        for begin in range(first[which], first[which + 1], LANES):
            run_block(packed, inputs, begin, min(begin + LANES, first[which + 1]), buffers, out)
