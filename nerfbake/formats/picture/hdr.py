"""Read environment maps from Radiance pictures (.hdr).

    #?RADIANCE           or #?RGBE
    FORMAT=32-bit_rle_rgbe
    EXPOSURE=2           optional, several multiply: pixels are radiance times this
    COLORCORR=1 .9 1.1   the same for red, green and blue
    <tab>EXPOSURE=2      without effect: pcomb keeps the headers of its inputs in this way
                         an empty line
    -Y 512 +X 1024       rows from the top, columns from the left; other orders are rejected
    rows

A row is flat, 4 bytes a pixel, or run-length coded:

    2 | 2 | W high | W low | red, green, blue, exponent: each W bytes as runs
    run: 128 + n | byte, n times          n | n bytes, n is 1 to 128

A pixel is (red, green, blue) 2^(exponent - 136); exponent 0 is black.
Source: Ward, "Real pixels" (Graphics Gems II, 1991); Radiance's file formats, "picture".
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.coding.rgbe import unpack_rows
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.environment import EnvironmentMap

_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_MAX_HEADER = 1 << 16
_RUN_WIDTHS = range(8, 1 << 15)  # of rows that can be run-length coded
_MOST_RUN = 127
_BAND = 1 << 16  # pixels that are decoded at once


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a Radiance picture."""
    return bytes(view[:16]).startswith(_MAGIC)


def decode(view: memoryview) -> EnvironmentMap:
    """Read an environment map. Raises InvalidFile, InvalidScene, MemoryLimit."""
    (height, width), exposure, start = _header(bytes(view[:_MAX_HEADER]))
    body = view[start:]
    # The least that rows can take: runs of 127 bytes, in 4 channels.
    least = min(4 * width, 4 + 8 * -(-width // _MOST_RUN)) if width in _RUN_WIDTHS else 4 * width
    if len(body) < least * height:
        found = f"declares {width:,}x{height:,} pixels, but has {len(body):,} bytes of them"
        raise InvalidFile(Problem("the picture", found, f"at least {least * height:,}"))
    memory.hold("an environment map", 12 * width * height)
    with memory.scope():
        band = max(1, _BAND // width)  # rows
        memory.hold("the pixels of an environment map", 9 * width * height + 72 * width * min(band, height))
        coded = np.empty((height, width, 4), np.uint8)
        row = unpack_rows(np.frombuffer(body, np.uint8), coded)
        if row >= 0:
            found = f"row {row:,} is cut off or has broken runs"
            raise InvalidFile(Problem("the picture", found, "whole rows, flat or with runs of a channel each"))
        light = np.empty((height, width, 3), np.float32)
        for top in range(0, height, band):  # in float64 all pixels would take several times the memory of the map
            light[top : top + band] = _radiance(coded[top : top + band], exposure)
        return EnvironmentMap(light)


def _radiance(coded: npt.NDArray[np.uint8], exposure: Floats) -> npt.NDArray[np.float32]:
    power = coded[..., 3:].astype(np.int32) - 136
    light = np.ldexp(coded[..., :3].astype(np.float64), power) / exposure
    with np.errstate(over="ignore"):
        return np.where(coded[..., 3:] > 0, light, 0).astype(np.float32)


def _header(head: bytes) -> tuple[tuple[int, int], Floats, int]:
    """Return (H, W), the exposure of each channel and where the rows start."""
    exposure, place = np.ones(3), 0
    lines = head.split(b"\n")
    if not head.startswith(_MAGIC):
        raise InvalidFile(Problem("the picture", "is not a Radiance picture", "#?RADIANCE at its start"))
    for number, line in enumerate(lines[:-1]):
        place += len(line) + 1
        name, _, value = line.rstrip().partition(b"=")
        if name == b"FORMAT" and value != b"32-bit_rle_rgbe":
            raise InvalidFile(Problem("FORMAT", f"is {_shown(value)}", "32-bit_rle_rgbe"))
        if name == b"EXPOSURE":
            exposure *= _positive("EXPOSURE", value)
        if name == b"COLORCORR":
            words = value.split()
            if len(words) != 3:
                raise InvalidFile(Problem("COLORCORR", f"is {_shown(value)}", "three numbers above 0"))
            exposure *= [_positive("COLORCORR", word) for word in words]
        if not ((exposure > 1e-30) & (exposure < 1e30)).all():
            raise InvalidFile(Problem("EXPOSURE", f"is {exposure[0]:g} in all", "1e-30 to 1e30"))
        if not line.strip() and number + 2 < len(lines):
            size = lines[number + 1]
            return _size(size), exposure, place + len(size) + 1
    raise InvalidFile(Problem("the picture", "has no end of its header", f"within {_MAX_HEADER:,} bytes"))


def _size(line: bytes) -> tuple[int, int]:
    words = line.split()
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X" or not all(w.isdigit() for w in words[1::2]):
        raise InvalidFile(Problem("the size", f"is {_shown(line)}", "-Y HEIGHT +X WIDTH, the usual order of pixels"))
    if max(map(len, words)) > 8 or not all(0 < int(word) <= MAX_EDGE for word in words[1::2]):
        raise InvalidFile(Problem("the size", f"is {_shown(line)}", f"1 to {MAX_EDGE:,} pixels an edge"))
    height, width = int(words[1]), int(words[3])
    if width != 2 * height:
        found = f"has {width:,}x{height:,} pixels"
        raise InvalidFile(Problem("the environment map", found, "an equirectangular map, twice as wide as high"))
    return height, width


def _positive(name: str, value: bytes) -> float:
    try:
        found = float(value)
    except ValueError:
        found = math.nan
    if not 0 < found < math.inf:
        raise InvalidFile(Problem(name, f"is {_shown(value)}", "a number above 0"))
    return found


def _shown(text: bytes) -> str:
    return repr(text[:40].decode("ascii", "replace"))
