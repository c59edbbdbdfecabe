"""What every reader of a transforms.json does first: the object, its frames, and where they stand."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats._capture import MAX_FRAMES
from nerfbake.formats._json import kind_of, parse_object, table

Fields = dict[str, Any]


def parse(view: memoryview) -> tuple[Fields, list[Fields]]:
    """All fields, and the frames. Comments are passed over, as instant-ngp does."""
    fields = parse_object(view, "the JSON", comments=True)
    frames = fields.get("frames")
    if not isinstance(frames, list) or not 1 <= len(frames) <= MAX_FRAMES:
        found = f"are {len(frames):,}" if isinstance(frames, list) else "are no list"
        raise InvalidFile(Problem("frames", found, f"1 to {MAX_FRAMES:,} frames"))
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InvalidFile(Problem(f"frames[{i}]", f"is {kind_of(frame)}", "an object with a transform_matrix"))
    return fields, frames


def pose_of(frame: Fields, index: int) -> npt.NDArray[np.float64]:
    """(4, 4) camera to world, OpenGL axes. Of a camera that moves while it takes a picture, where it starts."""
    starts = "transform_matrix" not in frame and "transform_matrix_start" in frame
    key = "transform_matrix_start" if starts else "transform_matrix"
    rows = frame.get(key)
    edge = len(rows) if isinstance(rows, list) and len(rows) == 3 else 4
    pose = np.eye(4)
    pose[:edge] = table(rows, f"frames[{index}].{key}", (edge, 4))
    return pose


def decode_positions(view: memoryview) -> npt.NDArray[np.float64]:
    """(c, 3) where the frames' cameras stand, in the file's own world."""
    try:
        return np.array([pose_of(frame, i)[:3, 3] for i, frame in enumerate(parse(view)[1])])
    except InvalidFile as error:
        problem = error.problem
        raise InvalidFile(problem._replace(place=f"transforms.json: {problem.place}")) from None
