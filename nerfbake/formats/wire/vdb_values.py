"""The stored values of VDB nodes in any format: values that are active, or differ from the background."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Words


class StoredValues(NamedTuple):
    """The stored voxels or tiles of consecutive nodes: a bit mask, the values (q, c), and which are active (q,)."""

    mask: Words
    values: npt.NDArray[Any]
    active: Bits


def concatenate(parts: Iterable[StoredValues]) -> StoredValues:
    """Concatenate the values of consecutive nodes."""
    return StoredValues(*map(np.concatenate, zip(*parts, strict=True)))


def differs_from_background(values: npt.NDArray[Any], background: npt.NDArray[Any]) -> Bits:
    """(..., c) -> (...): True where a value is not the background. NaN equals NaN."""
    own = background.astype(values.dtype)
    apart: Bits = ((values != own) & ~(np.isnan(values) & np.isnan(own))).any(axis=-1)
    return apart
