"""N x N rays a pixel: pictures of finer pixels, and their means."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from nerfbake import memory, progress
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.camera import Camera, require_samples
from nerfbake.scene.image import Image

RAYS = 1 << 18  # at a time: some 50 MB, and enough to do for every core
_PIXEL_BYTES = 20  # of the whole picture, which is held while its parts are made


def supersampled(render: Callable[[Camera], Image], camera: Camera, samples: int) -> Image:
    """What render() makes of the camera with samples x samples rays a pixel, through the middles of as many squares.

    Colour and alpha are means, of sRGB values as they are; depth is the mean weighted by alpha. One ray a pixel is
    what render() itself makes. The picture is made in parts of at most RAYS rays, or a row of pixels. Raises
    InvalidScene for another number of samples than 1 to 8.
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
    """One pixel for each N x N. Added up in a fixed order: the same bits on every CPU."""
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
