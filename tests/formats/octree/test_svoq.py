"""Compressed octrees: what is written is read, by a reader that knows the page alone too; nothing is believed."""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake import SparseVoxelOctree, load, memory_limit, save
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit, NerfbakeError, UsageError
from nerfbake.formats.octree.svoq import CODINGS, Coding, coded_size, decode_quantised, describe_packing, encode
from nerfbake.scene.quantised_octree import MAX_VALUE, QuantisedOctree
from tests.support import svoq_reference
from tests.support.quantised import random_quantised

each_coding = pytest.mark.parametrize("coding", CODINGS)
MASKS_AT, LEAVES_AT, PARTS_AT = 16, 20, 104


def part_sizes(data: bytes) -> dict[str, int]:
    sizes: dict[str, int] = describe_packing(memoryview(data))["bytes_of_parts"]
    return sizes


def written(octree: QuantisedOctree, coding: Coding = "range") -> bytes:
    return b"".join(encode(octree, coding=coding))


def sealed(data: bytes) -> bytes:
    """With the checksum that it then needs."""
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def refusal(data: bytes) -> str:
    with pytest.raises(NerfbakeError) as error:
        decode_quantised(memoryview(data))
    assert "; allowed: " in str(error.value)
    return str(error.value)


def assert_same(found: QuantisedOctree, octree: QuantisedOctree) -> None:
    for name, value in vars(octree).items():
        assert_array_equal(getattr(found, name), value, err_msg=name)


@each_coding
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["RGBA", "SH1", "SH4", "SH9", "SH16", "SH25"]), st.integers(0, 3))
def test_what_is_written_is_read(coding: Coding, seed: int, data_format: str, levels: int) -> None:
    octree = random_quantised(seed, levels=levels, data_format=data_format)
    data = written(octree, coding)
    assert_same(decode_quantised(memoryview(data)), octree)
    assert coded_size(octree, coding=coding) == len(data) == sum(part_sizes(data).values())


def test_an_octree_is_coded_once_for_its_size_and_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    octree = random_quantised(1, levels=3)
    size = coded_size(octree)
    monkeypatch.setattr("nerfbake.formats.octree.svoq.coefficients", None)
    assert len(written(octree)) == size
    assert len(written(octree, "deflate")) != size
    with pytest.raises(AttributeError):
        written(octree)  # only the last coding is kept


@each_coding
@pytest.mark.parametrize(("data_format", "levels", "spread"), [("RGBA", 4, 5), ("SH9", 3, 2), ("SH16", 3, 500)])
def test_a_reader_written_from_the_page_finds_the_same(
    coding: Coding, data_format: str, levels: int, spread: float
) -> None:
    octree = random_quantised(7, levels=levels, data_format=data_format, spread=spread)
    found = svoq_reference.read(written(octree, coding))
    assert found["masks"] == octree.masks.tolist()
    assert found["values"] == octree.values.tolist()
    assert found["mixing"] == octree.mixing.tolist()
    if spread < 100:  # else densities are beyond float32
        assert_array_equal(octree.leaf_values(), np.array(svoq_reference.leaves_of(found), np.float32))


def test_the_largest_numbers_come_back_and_larger_ones_are_refused() -> None:
    octree = random_quantised(1)
    octree.values[5, :3] = octree.values[0, :3] = MAX_VALUE, -MAX_VALUE, MAX_VALUE - 1
    for coding in CODINGS:
        assert_same(decode_quantised(memoryview(written(octree, coding))), octree)
    octree.values[5, 0] += 1
    with pytest.raises(InvalidScene, match="values reach"):
        encode(octree)


@each_coding
def test_a_file_is_an_octree_to_everybody(coding: Coding, tmp_path: Path) -> None:
    octree = random_quantised(4, data_format="SH1", spread=0.5)
    save(tmp_path / "a.svoq", octree, coding=coding)
    found = load(tmp_path / "a.svoq", SparseVoxelOctree)
    leaves = found.node_data[found.childless]
    assert_array_equal(leaves, octree.leaf_values())


def test_zstd_around_it_is_refused_with_the_reason(tmp_path: Path) -> None:
    octree = random_quantised(4)
    with pytest.raises(UsageError, match="compressed already"):
        save(tmp_path / "a.svoq.zst", octree)
    assert list(tmp_path.iterdir()) == []


# -- files that are not what they claim ------------------------------------------------------------------------
@each_coding
def test_every_truncation_and_every_flipped_bit_is_found(coding: Coding) -> None:
    data = written(random_quantised(5, levels=2), coding)
    for end in range(0, len(data), 7):
        refusal(data[:end])
    refusal(data + b"\0")
    for at in range(0, len(data), 3):
        refusal(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :])


@each_coding
def test_declared_leaves_are_held_against_the_bytes_before_anything_is_made(coding: Coding) -> None:
    data = bytearray(written(random_quantised(5), coding))
    struct.pack_into("<I", data, LEAVES_AT, 0xFFFFFFFF)
    assert "leaves are 4,294,967,295; allowed: 1 to" in refusal(sealed(bytes(data)))
    struct.pack_into("<II", data, MASKS_AT, 0xFFFFFFFF, 1000)
    assert "masks are 4,294,967,295; allowed: up to 13,000" in refusal(sealed(bytes(data)))
    struct.pack_into("<I", data, LEAVES_AT, 0)
    assert "leaves are 0" in refusal(sealed(bytes(data)))


@each_coding
def test_what_does_not_fit_is_refused_before_it_is_made(coding: Coding) -> None:
    data = written(random_quantised(6, levels=4, fill=0.8), coding)
    with memory_limit(1 << 14), pytest.raises(MemoryLimit):
        decode_quantised(memoryview(data))


def test_a_decoder_that_could_invent_data_for_ever_stops() -> None:
    """As many leaves as so many bytes may have, and streams of zeros, which can be decoded without end."""
    octree = random_quantised(5, levels=1, data_format="SH25")
    data = bytearray(written(octree) + bytes(100_000))
    struct.pack_into("<I", data, PARTS_AT + 3 * 12 + 4, len(data))
    leaves = 200_000
    struct.pack_into("<II", data, MASKS_AT, leaves, leaves)
    count = data[7]
    starts = PARTS_AT + 12 * count
    sizes = [struct.unpack_from("<I", data, PARTS_AT + 12 * i + 4)[0] for i in range(count)]
    struct.pack_into("<I", data, PARTS_AT + 12 * (count - 1) + 4, len(data) - 4 - starts - sum(sizes[:-1]))
    begin = time.process_time()
    refusal(sealed(bytes(data)))
    assert time.process_time() - begin < 5


def changed(change: Callable[[bytearray], Any], coding: Coding = "range") -> str:
    data = bytearray(written(random_quantised(5), coding))
    change(data)
    return refusal(sealed(bytes(data)))


@pytest.mark.parametrize(
    ("at", "value", "told"),
    [
        (0, b"SVOX", "starts with"),
        (4, b"\2", "version is 2; allowed: 1"),
        (5, b"\7", "coding is 7"),
        (6, b"\5", "basis is 5"),
        (6, b"\1", "end at channels"),
        (7, b"\0", "has"),
        (8, b"\0\0", "size"),
        (8, b"\xff\xff", "size"),
        (MASKS_AT, b"\1\0", "topology"),
        (24, b"\0\0\0\0\0\0\xf8\x7f", "origin"),
        (72, b"\0\0\0\0\0\0\xf8\x7f", "colour_step"),
        (PARTS_AT, b"\2", "kinds"),
        (PARTS_AT + 2 * 12 + 1, b"\x0e", "end at channels"),
        (PARTS_AT + 3 * 12 + 1, b"\x0e", "end at channels"),
    ],
)
def test_headers_that_cannot_be_are_refused_in_a_line(at: int, value: bytes, told: str) -> None:
    def change(data: bytearray) -> None:
        data[at : at + len(value)] = value

    assert told in changed(change)


@pytest.mark.parametrize("part", [0, 1, 2, 3])
@pytest.mark.parametrize("more", [-1, 1, 8])
def test_streams_take_exactly_their_bytes(part: int, more: int) -> None:
    """A byte taken away from a part, or added to it, with all lengths as they then are."""

    def change(data: bytearray) -> None:
        count = data[7]
        sizes = [struct.unpack_from("<I", data, PARTS_AT + 12 * i + 4)[0] for i in range(count)]
        end = PARTS_AT + 12 * count + sum(sizes[: part + 1])
        data[end + min(more, 0) : end] = bytes(max(more, 0))
        struct.pack_into("<I", data, PARTS_AT + 12 * part + 4, sizes[part] + more)

    changed(change)


def test_an_octree_too_regular_for_its_bytes_is_padded() -> None:
    """512 x 512 x 1 equal voxels take next to nothing; a reader believes only so many leaves a byte."""
    levels = 9
    masks = np.full(sum(4**level for level in range(levels)), 0b1111, np.uint8)
    flat = replace(
        random_quantised(1, data_format="RGBA"),
        size=(512, 512, 1),
        masks=masks,
        values=np.zeros((4**levels, 4), np.int32),
    )
    data = written(flat)
    sizes = part_sizes(data)
    assert 0 <= len(data) - 4**levels // 256 < 20
    assert sizes["padding"] > len(data) / 2
    assert_same(decode_quantised(memoryview(data)), flat)
    at = len(data) - 5
    with pytest.raises(InvalidFile, match="padding has non-zero bytes"):
        decode_quantised(memoryview(sealed(data[:at] + b"\1" + data[at + 1 :])))
