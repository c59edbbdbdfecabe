"""Supersampling with N x N rays per pixel: render finer pixels, and average them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TypeVar

import numpy as np

from nerfbake import memory, progress
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.camera import Camera, require_samples
from nerfbake.scene.image import Image

RAYS = 1 << 18  # rays at a time: about 50 MB, and enough work for every core
_ROWS = 32  # of pixels that a core averages at a time
_PIXEL_BYTES = 20  # per pixel of the whole picture, which stays in memory while its parts are rendered


Fine = TypeVar("Fine")


def supersampled(render: Callable[[Camera], Image], camera: Camera, samples: int) -> Image:
    """Call render() for samples x samples rays per pixel, through the centres of equal squares, and average them.

    Colour and alpha are means; colours are averaged in sRGB. Depth is the mean weighted by alpha. With one sample the
    result is that of render(). Raises InvalidScene unless there are 1 to 8 samples.
    """
    return in_parts(render, _means, camera, samples)


def in_parts(
    look: Callable[[Camera], Fine], average: Callable[[Fine, int], Image], camera: Camera, samples: int
) -> Image:
    """Call look() for N x N rays per pixel, through the centres of equal squares, and average() for the picture of it.

    average() takes the result of look(), and N. The picture is made in parts of at most RAYS rays, or one row of
    pixels. Raises InvalidScene unless there are 1 to 8 samples.
    """
    N = require_samples(samples)
    if N == 1:
        return average(look(camera), 1)
    W, H = camera.width, camera.height
    across = min(W, MAX_EDGE // N)
    down = max(1, RAYS // (N * N * across))
    with memory.lent(f"a picture of {W}x{H} pixels", _PIXEL_BYTES * W * H):
        colour = np.empty((H, W, 3), np.float32)
        alpha, depth = np.empty((H, W), np.float32), np.empty((H, W), np.float32)
        for y, x in progress.each(list(product(range(0, H, down), range(0, W, across)))):
            rows, columns = slice(y, min(y + down, H)), slice(x, min(x + across, W))
            part = average(look(camera.part(columns, rows, finer=N)), N)
            colour[rows, columns], alpha[rows, columns], depth[rows, columns] = part.colour, part.alpha, part.depth
    return Image(colour, alpha, depth, part.background)


def _means(fine: Image, N: int) -> Image:
    """Average each N x N pixels to one."""
    if N == 1:
        return fine
    alpha, depth = mean_depth(fine.alpha, fine.depth, N)
    return Image(block_means(fine.colour, N).astype(np.float32), alpha, depth, fine.background)


def block_means(fine: Singles, N: int) -> Floats:
    """(H, W, ...) means of each N x N of (H N, W N, ...), with sums in a fixed order, the same on every CPU."""
    means = np.empty((len(fine) // N, fine.shape[1] // N, *fine.shape[2:]))

    def add(begin: int, end: int) -> None:
        rows, total = fine[N * begin : N * end], np.zeros_like(means[begin:end])
        for y, x in product(range(N), range(N)):
            total += rows[y::N, x::N]
        means[begin:end] = total / (N * N)

    over_chunks(add, len(means), _ROWS)
    return means


def mean_depth(alpha: Singles, depth: Singles, N: int) -> tuple[Singles, Singles]:
    """(H, W) the mean alpha and the mean depth, weighted by alpha, of each N x N pixels."""
    size = len(alpha) // N, alpha.shape[1] // N
    mean_alpha, mean = np.empty(size, np.float32), np.empty(size, np.float32)

    def add(begin: int, end: int) -> None:
        rows = slice(N * begin, N * end)
        total, far = np.zeros((end - begin, size[1])), np.zeros((end - begin, size[1]))
        for y, x in product(range(N), range(N)):
            weights = alpha[rows][y::N, x::N]
            total += weights
            far += weights.astype(np.float64) * depth[rows][y::N, x::N]
        mean_alpha[begin:end] = total / (N * N)
        mean[begin:end] = np.divide(far, total, out=np.zeros_like(far), where=total > 0)

    over_chunks(add, len(mean), _ROWS)
    return mean_alpha, mean
