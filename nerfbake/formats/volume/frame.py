"""Encode and parse the octree's frame: JSON, stored in VDB files under the name `nerfbake`, doubles without loss."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import key_place, parse_object, shorten, table, whole
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.octree import MAX_SIZE
from nerfbake.scene.volume import OctreeFrame

NAME = "nerfbake"
MAX_TEXT = 1 << 20


def frame_text(frame: OctreeFrame) -> str:
    """Return the frame as JSON."""
    fields = {
        "size": list(frame.size),
        "data_format": frame.data_format,
        "layout": frame.layout,
        "origin": frame.origin.tolist(),
        "voxel_size": frame.voxel_size.tolist(),
        "extra_data": None if frame.extra_data is None else frame.extra_data.tolist(),
    }
    return json.dumps(fields)


def parse_frame(text: bytes | memoryview) -> OctreeFrame:
    """Parse a frame from a file. Raises InvalidFile if the text is not a frame."""
    if len(text) > MAX_TEXT:
        raise InvalidFile(Problem(NAME, f"has {len(text):,} bytes", f"{MAX_TEXT:,} at most"))
    fields = parse_object(text, NAME)
    size, data_format, layout = (fields.get(key) for key in ("size", "data_format", "layout"))
    if not isinstance(size, list) or len(size) != 3 or not isinstance(data_format, str):
        raise InvalidFile(Problem(NAME, "has no size or no data_format", "the frame of an octree"))
    if layout not in ("full", "compact"):
        raise InvalidFile(Problem(key_place(NAME, "layout"), f"is {shorten(layout)}", "full or compact"))
    edges = dict(zip("xyz", size, strict=True))
    width, height, depth = (whole(edges, axis, key_place(NAME, "size"), low=1, high=MAX_SIZE) for axis in "xyz")
    return OctreeFrame(
        (width, height, depth),
        data_format,
        layout,
        table(fields.get("origin"), key_place(NAME, "origin"), (3,)),
        table(fields.get("voxel_size"), key_place(NAME, "voxel_size"), (3,)),
        _lobes(fields.get("extra_data"), data_format),
    )


def _lobes(values: Any, data_format: str) -> npt.NDArray[np.float32] | None:
    if values is None:
        return None
    return table(values, key_place(NAME, "extra_data"), (parse_basis(data_format).size, None)).astype(np.float32)
