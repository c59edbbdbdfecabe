"""Where the cameras of a transforms.json stand: NeRF-Synthetic's list of posed images."""

from __future__ import annotations

import json

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, MemoryLimit, Problem

_NAME = "transforms.json"
_MAX_SIZE = 256 << 20


def decode_positions(view: memoryview, *, max_memory: int) -> npt.NDArray[np.float64]:
    """(c, 3) the last columns of the frames' camera-to-world matrices, in the file's own world."""
    if len(view) > min(_MAX_SIZE, max_memory):
        raise MemoryLimit(_NAME, len(view), min(_MAX_SIZE, max_memory))
    try:
        frames = json.loads(bytes(view))["frames"]
        matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        found = f"cannot be read ({type(error).__name__}: {error})"
        raise InvalidFile(Problem(_NAME, found, "frames, each with a transform_matrix")) from None
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)) or not np.isfinite(matrices).all():
        found = f"has matrices of shape {matrices.shape}"
        raise InvalidFile(Problem(f"{_NAME}: transform_matrix", found, "4 x 4 finite numbers for at least one frame"))
    return matrices[:, :3, 3]
