"""Where the cameras of a transforms.json stand: NeRF-Synthetic's list of posed images."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats._json import parse_object, table

_NAME = "transforms.json"


def decode_positions(view: memoryview) -> npt.NDArray[np.float64]:
    """(c, 3) the last columns of the frames' camera-to-world matrices, in the file's own world."""
    frames = parse_object(view, _NAME).get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InvalidFile(Problem(f"{_NAME}: frames", "is no list of objects", "one object a frame"))
    matrices = table([frame.get("transform_matrix") for frame in frames], f"{_NAME}: transform_matrix", (None,) * 3)
    if matrices.shape[1:] not in ((3, 4), (4, 4)):
        found = f"has matrices of shape {matrices.shape[1:]}"
        raise InvalidFile(Problem(f"{_NAME}: transform_matrix", found, "3 x 4 or 4 x 4 numbers"))
    return matrices[:, :3, 3]
