"""Supersampling with N x N rays per pixel: render finer pixels, and average them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from nerfbake import memory, progress
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.camera import Camera, require_samples
from nerfbake.scene.image import Image

RAYS = 1 << 18  # rays at a time: about 50 MB, and enough work for every core
_PIXEL_BYTES = 20  # per pixel of the whole picture, which stays in memory while its parts are rendered


def supersampled(render: Callable[[Camera], Image], camera: Camera, samples: int) -> Image:
    """Call render() for samples x samples rays per pixel, through the centres of equal squares, and average them.

    Colour and alpha are means; colours are averaged in sRGB. Depth is the mean weighted by alpha. With one sample the
    result is that of render(). The picture is rendered in parts of at most RAYS rays, or one row of pixels. Raises
    InvalidScene unless there are 1 to 8 samples.
    """
    N = require_samples(samples)
    if N == 1:
        return render(camera)
    W, H = camera.width, camera.height
    across = min(W, MAX_EDGE // N)
    down = max(1, RAYS // (N * N * across))
    with memory.lent(f"a picture of {W}x{H} pixels", _PIXEL_BYTES * W * H):
        colour = np.empty((H, W, 3), np.float32)
        alpha, depth = np.empty((H, W), np.float32), np.empty((H, W), np.float32)
        for y, x in progress.each(list(product(range(0, H, down), range(0, W, across)))):
            rows, columns = slice(y, min(y + down, H)), slice(x, min(x + across, W))
            part = _means(render(camera.part(columns, rows, finer=N)), N)
            colour[rows, columns], alpha[rows, columns], depth[rows, columns] = part.colour, part.alpha, part.depth
    return Image(colour, alpha, depth, part.background)


def _means(fine: Image, N: int) -> Image:
    """Average each N x N pixels to one. The order of the sums is fixed, so that every CPU returns the same bits."""
    H, W = fine.alpha.shape
    colour, alpha, far = np.zeros((H // N, W // N, 3)), np.zeros((H // N, W // N)), np.zeros((H // N, W // N))
    for y, x in product(range(N), range(N)):
        colour += fine.colour[y::N, x::N]
        alpha += fine.alpha[y::N, x::N]
        far += fine.alpha[y::N, x::N].astype(np.float64) * fine.depth[y::N, x::N]
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    single = np.float32
    return Image(
        (colour / (N * N)).astype(single), (alpha / (N * N)).astype(single), depth.astype(single), fine.background
    )
