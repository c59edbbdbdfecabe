"""Read Gaussian splats from .splat files: rows of 32 bytes, without a header.

    0       12      24        28
    | x y z | scales | r g b a | w x y z |     3 + 3 float32, 4 + 4 bytes

Scales are linear. A colour byte is c / 255, and the first SH coefficient is (c / 255 - 1/2) / 0.28209479; there are no
others. A quaternion's byte is (q - 128) / 128, of any length.

Source: antimatter15/splat (convert.py).
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.scene.basis import SH0
from nerfbake.scene.splats import SplatRows, Splats, splats_in_blocks

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quat", "u1", 4)])
_LOOKED_AT = 64  # rows
_PLAUSIBLE = 1e6  # coordinates and scales, world units
_UNIT = 0.05  # how far from 1 the length of a quaternion may be after rounding


def recognise(view: memoryview) -> bool:
    """Return True if the first rows have finite numbers, scales from 0, and unit quaternions."""
    if not len(view) or len(view) % _ROW.itemsize:
        return False
    rows = np.frombuffer(view, _ROW, min(_LOOKED_AT, len(view) // _ROW.itemsize))
    lengths = np.sqrt((((rows["quat"] - 128.0) / 128) ** 2).sum(axis=1))
    with np.errstate(invalid="ignore"):
        good = (np.abs(rows["mean"]) < _PLAUSIBLE) & (rows["scale"] >= 0) & (rows["scale"] < _PLAUSIBLE)
    return bool(good.all() and (np.abs(lengths - 1) < _UNIT).all())


def decode(view: memoryview) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit."""
    size = _ROW.itemsize
    if len(view) % size:
        raise InvalidFile(
            Problem("the .splat", f"has {len(view):,} bytes", f"a multiple of {size}, the bytes of a row")
        )
    n = len(view) // size
    table = np.frombuffer(view, _ROW, n)

    def rows(block: slice) -> SplatRows:
        part = table[block]
        colour = part["colour"] / 255
        with np.errstate(invalid="ignore"):
            means, scales = part["mean"] * np.float64(1), part["scale"] * np.float64(1)
        sh = ((colour[:, :3] - 0.5) / SH0)[:, None]
        return SplatRows(means, scales, (part["quat"] - 128.0) / 128, colour[:, 3], sh)

    return splats_in_blocks(n, 1, rows)
