"""What nodes of a VDB file hold, whatever the format: values that are active, or not the background."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Words


class Held(NamedTuple):
    """Of a run of nodes the voxels or tiles that have values of their own, those (q, c), and which are active (q,)."""

    mask: Words
    values: npt.NDArray[Any]
    active: Bits


def joined(parts: Iterable[Held]) -> Held:
    """Node behind node."""
    return Held(*map(np.concatenate, zip(*parts, strict=True)))


def differs(values: npt.NDArray[Any], background: npt.NDArray[Any]) -> Bits:
    """(..., c) -> (...) whether a value is not the background; NaN is itself here."""
    own = background.astype(values.dtype)
    apart: Bits = ((values != own) & ~(np.isnan(values) & np.isnan(own))).any(axis=-1)
    return apart
