"""The frame of an octree that a volume's metadata carry."""

from __future__ import annotations

import pytest

from nerfbake.errors import InvalidFile
from nerfbake.formats.volume.frame import parse_frame


@pytest.mark.parametrize(
    "frame",
    [
        b"{}",
        b"[1, 2",
        b"[" * 100_000,
        b'{"size": [9, 9], "data_format": "SH1", "layout": "full", "origin": 0, "voxel_size": 1, "extra_data": null}',
        b'{"size": [1e400, 9, 9]}',
        b"\xff\xfe",
    ],
)
def test_a_frame_that_is_none_is_refused(frame: bytes) -> None:
    with pytest.raises(InvalidFile) as error:
        parse_frame(frame)
    assert str(error.value).startswith("nerfbake ")
