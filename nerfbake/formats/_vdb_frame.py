"""The octree's frame as text, which VDB files carry under the name `nerfbake`: JSON, doubles to the last bit."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.octree import MAX_SIZE
from nerfbake.scene.volume import OctreeFrame

NAME = "nerfbake"
MAX_TEXT = 1 << 20


def frame_text(frame: OctreeFrame) -> str:
    """Ready to be stored."""
    fields = {
        "size": list(frame.size),
        "data_format": frame.data_format,
        "layout": frame.layout,
        "origin": frame.origin.tolist(),
        "voxel_size": frame.voxel_size.tolist(),
        "extra_data": None if frame.extra_data is None else frame.extra_data.tolist(),
    }
    return json.dumps(fields)


def parse_frame(text: bytes) -> OctreeFrame:
    """The frame of a file. Raises InvalidFile where it is none."""
    if len(text) > MAX_TEXT:
        raise InvalidFile(Problem(NAME, f"has {len(text):,} bytes", f"{MAX_TEXT:,} at most"))
    try:
        fields: dict[str, Any] = json.loads(text)
        size = tuple(int(edge) for edge in fields["size"])
        data_format, layout, lobes = str(fields["data_format"]), fields["layout"], fields["extra_data"]
        frame = OctreeFrame(
            (size[0], size[1], size[2]),
            data_format,
            layout,
            _floats(fields["origin"], (3,)),
            _floats(fields["voxel_size"], (3,)),
            None if lobes is None else _floats(lobes, (parse_basis(data_format).size, -1)).astype(np.float32),
        )
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise InvalidFile(Problem(NAME, f"cannot be read ({type(error).__name__})", "the frame of an octree")) from None
    if layout not in ("full", "compact") or len(size) != 3 or not all(1 <= edge <= MAX_SIZE for edge in size):
        raise InvalidFile(Problem(NAME, f"says {layout} octree of {size}", f"full or compact, 1 to {MAX_SIZE} voxels"))
    return frame


def _floats(values: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    return np.array(values, np.float64).reshape(shape)
