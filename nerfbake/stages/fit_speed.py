"""How much faster than two cores a graphics device fits."""

from __future__ import annotations

import time

import numpy as np

from nerfbake.device.fit import DeviceVisit, FitPasses, Losses, Pixels
from nerfbake.device.gpu import Gpu
from nerfbake.kernels.fit.colours import tile_order
from nerfbake.kernels.fit.update import LearningRates
from nerfbake.stages._bricks import cells_of_solid

_CELLS, _PIXELS, _BASIS, _VISITS = 128, 256, 9, 4
_TWO_CORES = 0.09  # seconds of such a visit on two cores of an EPYC
_HOST = 0.05  # of the time of a fit on two cores: pictures, plans and copies, which the device does not do


def measure_speed(gpu: Gpu) -> float:
    """Return how many times faster than two cores a device fits, host work included. Raises DeviceError.

    It visits one view of a hollow ball a few times. The shaders are compiled before.
    """
    axis = (np.arange(_CELLS) + 0.5) / _CELLS - 0.5
    away = np.sqrt(np.square(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"))).sum(axis=0))
    cells = cells_of_solid((away > 0.44) & (away < 0.48), np.array([[-0.5] * 3, [0.5] * 3]), _BASIS, 0.5)
    passes = FitPasses(gpu)
    passes.upload(cells.bricks, cells.means, cells.seen)
    tiles = tile_order(_PIXELS, _PIXELS)
    rows, columns = np.divmod(np.arange(64), 8)
    numbers = ((tiles[:, None] >> 16) * 8 + rows) * _PIXELS + (tiles[:, None] & 0xFFFF) * 8 + columns
    targets = np.full((_PIXELS**2, 4), 0.5, np.float32)
    optics = 2.0 * _PIXELS, 2.0 * _PIXELS, _PIXELS / 2, _PIXELS / 2
    eye, turn = np.array([0.0, 0.0, 2.0]), np.eye(3)
    background, unknown = (1.0, 1.0, 1.0), np.zeros(0, np.float32)
    numbers = numbers.reshape(-1).astype(np.int32)
    pixels = Pixels(numbers, targets, eye, turn, optics, _PIXELS, background, unknown)
    view, ones = passes.upload_view(pixels), np.ones(_BASIS, np.float32)
    visit = DeviceVisit(view, 2, Losses(2.0), np.ones(3), LearningRates(0.1, 0.4, ones, 0.01 * ones, 4.0))
    passes.visit([visit], counted=True)
    start = time.perf_counter()
    passes.visit([visit] * _VISITS, counted=True)
    share = (time.perf_counter() - start) / _VISITS / _TWO_CORES
    return 1 / (share + _HOST)
