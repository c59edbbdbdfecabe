"""Read and write depth as NumPy's .npy: (H, W) float32 in world units, 0 where a ray hits nothing."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.npy import MAX_HEADER, npy_pieces, read_header
from nerfbake.scene.image import Depth


def recognise(view: memoryview) -> bool:
    """True for the first bytes of an .npy."""
    return bytes(view[:6]) == np.lib.format.MAGIC_PREFIX


def encode(depth: Depth) -> Iterator[bytes | memoryview]:
    yield from npy_pieces(depth.distance)


def decode(view: memoryview) -> Depth:
    """Return the depth as a view of the file, without allocation."""
    stream = io.BytesIO(view[: MAX_HEADER + 12])
    shape, fortran, dtype = read_header("depth", stream)
    body = view[stream.tell() :]
    if len(shape) != 2 or fortran or dtype != np.dtype("<f4"):
        raise InvalidFile(Problem("depth", f"has shape {shape}, dtype {dtype}", "(H, W) float32, rows first"))
    if len(body) != 4 * math.prod(shape):
        raise InvalidFile(Problem("depth", f"has {len(body):,} bytes", f"{4 * math.prod(shape):,} for {shape}"))
    return Depth(np.frombuffer(body, np.float32).reshape(shape))
