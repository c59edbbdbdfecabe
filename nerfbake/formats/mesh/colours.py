"""Make the colours of vertices sound, the same way for .obj, .ply and .glb, with a note for each repair.

| stored | read as |
|---|---|
| NaN | grey |
| beyond 0 to 1, and infinite | clamped |
| all above 1, up to 255 | divided by 255 |
| integers without "normalized" in glTF, or 8 bits in 16 in PLY | divided by the largest integer, or 255 |

A file is not refused for its colours, because its triangles are valid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import cast

GREY = 0.75  # of vertices without a colour beside others, and of meshes without colours in pictures
_BYTE = 255
_OVER = 2.0  # a brightest value up to here is light that is too bright, not a byte
_DARK = 16  # bytes up to here are black on a screen
_ROUNDING = 1 / 255  # clamped without a note
_NOT_NUMBERS = "colours that are not numbers are grey"
_BYTES = "colours go to 255, and are divided by 255"
_CLAMPED = "colours outside 0 to 1 are clamped"
_INTEGERS = "colours are integers that are not marked as normalized, and are read as if they were"


def sound_colours(values: npt.NDArray[Any], *, grey: float = GREY, scaled: bool = False) -> tuple[Floats, list[str]]:
    """Return colours (v, 3) as numbers from 0 to 1, and what was changed.

    grey: the value of a channel of vertices with a NaN, in the space of the colours; scaled: the file tells that white
    is 1, because the colours are divided integers.
    """
    found = cast(values, np.float64)
    if not len(found) or (found.min() >= 0 and found.max() <= 1):  # False for NaN
        return found, []
    notes = []
    missing = np.isnan(found).any(axis=1)
    if missing.any():
        found = np.where(missing[:, None], grey, found)
        notes.append(_NOT_NUMBERS)
    if not scaled and _are_bytes(found[~missing]):
        found = found / _BYTE
        found[missing] = grey
        notes.append(_BYTES)
    if found.min() < -_ROUNDING or found.max() > 1 + _ROUNDING:
        notes.append(_CLAMPED)
    return np.clip(found, 0, 1), notes


def _are_bytes(found: Floats) -> bool:
    """Whether these go to 255: all vertices that are not black are brighter than 1, or all numbers are whole ones."""
    brightest = np.where(np.isfinite(found), found, 0).max(axis=1, initial=0)
    if not _OVER < (most := float(brightest.max(initial=0))) < _BYTE + 1:
        return False
    return bool((brightest[brightest > 0] > 1).all()) or (most > _DARK and bool((found == np.rint(found)).all()))


def normalised(values: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], list[str]]:
    """Return colours as floats whose largest is 1, of an accessor of floats or integers, and what was changed.

    Normalised integers are floats already. Programs forget `normalized`, without which white would be 255 times white.
    """
    if values.dtype.kind == "f" or not (values > 1).any():
        return values, []
    return values / np.float64(np.iinfo(values.dtype).max), [_INTEGERS]


def are_bytes_in_shorts(values: npt.NDArray[Any]) -> bool:
    """Whether 16-bit integers hold colours of 8 bits: none is above 255, and some would be black as 16 bits."""
    return bool(_DARK < values.max(initial=0) <= _BYTE)
