"""The streams of EXT_ and KHR_meshopt_compression, judged by meshoptimizer's own decoder, and damaged ones."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import pytest

from nerfbake import memory_limit
from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.wire.meshopt import decompress
from tests.support.meshopt_streams import STREAMS, Stream

each_stream = pytest.mark.parametrize("stream", STREAMS, ids=[stream.name for stream in STREAMS])


def decoded(stream: Stream, data: bytes | None = None, **changes: Any) -> bytes:
    told = {"count": stream.elements, "stride": stream.stride, "mode": stream.mode, "filter_": stream.filter, **changes}
    view = memoryview(base64.b64decode(stream.data) if data is None else data)
    return bytes(decompress(view, place="bufferViews[0]", **told))


@each_stream
def test_a_stream_is_decoded_as_meshoptimizer_does(stream: Stream) -> None:
    found, expected = decoded(stream), base64.b64decode(stream.expected)
    if stream.filter in ("OCTAHEDRAL", "QUATERNION", "COLOR"):  # specified to a unit of the last place
        kind = {4: "i1", 8: "<i2"}[stream.stride] if stream.filter != "COLOR" else {4: "u1", 8: "<u2"}[stream.stride]
        apart = np.frombuffer(found, kind).astype(int) - np.frombuffer(expected, kind)
        assert np.abs(apart).max() <= 1
    else:
        assert found == expected


@each_stream
def test_damage_is_refused_or_decoded_to_as_many_bytes(stream: Stream) -> None:
    data, random = base64.b64decode(stream.data), np.random.default_rng(0)
    refused = 0
    for length in range(0, len(data), max(1, len(data) // 16)):
        with pytest.raises(InvalidFile):
            decoded(stream, data[:length])
    for _ in range(60):
        broken = bytearray(data)
        for at in random.integers(0, len(data), 3):
            broken[at] = int(random.integers(256))
        try:
            assert len(decoded(stream, bytes(broken))) == stream.elements * stream.stride
        except InvalidFile:
            refused += 1
    assert refused or stream.mode == "TRIANGLES"


def test_what_the_extension_does_not_allow_is_refused() -> None:
    attributes, triangles, numbers = STREAMS[0], STREAMS[2], STREAMS[5]
    for stream, changes in (
        (attributes, {"stride": 6}),
        (attributes, {"stride": 260}),
        (attributes, {"filter_": "QUATERNION"}),
        (attributes, {"mode": "None"}),
        (attributes, {"filter_": "COLOR"}),
        (attributes, {"count": 0}),
        (triangles, {"count": triangles.elements + 1}),
        (triangles, {"stride": 8}),
        (numbers, {"filter_": "EXPONENTIAL"}),
        (numbers, {"stride": 2}),  # its numbers are larger
    ):
        with pytest.raises(InvalidFile, match=r"^bufferViews\[0\] "):
            decoded(stream, **changes)


def test_a_count_is_checked_before_memory_is_taken() -> None:
    with pytest.raises(InvalidFile, match=r"declares [0-9,]+ bytes from 890; allowed: 56,960 at most"):
        decoded(STREAMS[0], count=1 << 30)
    with memory_limit(1000), pytest.raises(MemoryLimit):
        decoded(STREAMS[0])


def test_a_version_1_stream_may_grow_more_but_not_without_limit() -> None:
    stream = next(stream for stream in STREAMS if stream.name == "xor v1")
    data = base64.b64decode(stream.data)
    assert data[0] == 0xA1
    with pytest.raises(
        InvalidFile, match=rf"declares [0-9,]+ bytes from {len(data)}; allowed: {1024 * len(data):,} at"
    ):
        decoded(stream, count=1 << 30)
    broken = bytearray(data)
    for mode in (0x03, 0x11):  # an unknown mode, and a rotation of pairs
        broken[-1] = mode
        with pytest.raises(InvalidFile, match="has damaged attributes"):
            decoded(stream, bytes(broken))
