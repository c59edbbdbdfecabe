from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from nerfbake import catalog
from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.wire import zstd
from nerfbake.io import check
from nerfbake.memory import memory_limit


def packed(*pieces: bytes) -> bytes:
    return b"".join(zstd.compress(pieces))


def unpacked(data: bytes, limit: int = 1 << 24) -> bytes:
    with memory_limit(limit):
        return bytes(zstd.decompress(memoryview(data)))


@given(st.lists(st.binary(max_size=5000)))
def test_what_is_compressed_comes_back(pieces: list[bytes]) -> None:
    data = packed(*pieces)
    assert unpacked(data) == b"".join(pieces)
    assert zstandard.ZstdDecompressor().stream_reader(data).read() == b"".join(pieces)


def test_the_same_content_gives_the_same_bytes() -> None:
    content = bytes(range(256)) * 20_000
    assert packed(content) == packed(content)
    assert zstandard.get_frame_parameters(packed(content)).has_checksum


def test_frames_one_after_the_other_are_one_stream() -> None:
    assert unpacked(packed(b"one ") + packed(b"two")) == b"one two"


@pytest.mark.parametrize("size", range(1, 20))
def test_a_frame_that_does_not_end_is_refused(size: int) -> None:
    with pytest.raises(InvalidFile, match=r"does not end by byte|is damaged"):
        unpacked(packed(b"some content")[:-size])


def test_frames_without_content_are_left_out() -> None:
    empty = (0x184D2A50).to_bytes(4, "little") + (3).to_bytes(4, "little") + b"abc"
    assert unpacked(empty + packed(b"content") + empty) == b"content"
    with pytest.raises(InvalidFile, match="does not end by byte"):
        unpacked(packed(b"content") + empty[:-1])


def test_small_blocks_are_unpacked_and_too_many_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of one byte, over and over: 20 times 'a' each, three of them in a frame."""
    head = b"\x28\xb5\x2f\xfd\x00\x58"
    block = (20 << 3 | 1 << 1).to_bytes(3, "little") + b"a"
    last = (20 << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"a"
    assert unpacked(head + 2 * block + last) == b"a" * 60
    monkeypatch.setattr(zstd, "_MOST_BLOCKS", 2)
    with pytest.raises(InvalidFile, match=r"has more than 2 blocks; allowed: 2"):
        unpacked(head + 2 * block + last)


def test_a_wrong_checksum_is_refused() -> None:
    data = bytearray(packed(bytes(1000)))
    data[-1] ^= 1
    with pytest.raises(InvalidFile, match=r"is damaged.*; allowed: zstd"):
        unpacked(bytes(data))


def test_what_stands_behind_a_frame_must_be_a_frame() -> None:
    with pytest.raises(InvalidFile, match="is damaged"):
        unpacked(packed(b"content") + b"more")


def test_a_window_beyond_the_limit_is_refused() -> None:
    parameters = zstandard.ZstdCompressionParameters(window_log=28, compression_level=1)
    compressor = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
    with pytest.raises(InvalidFile, match="is damaged"):
        unpacked(limit=1 << 28, data=compressor.compress(bytes(10)) + compressor.flush())


def test_a_bomb_stays_within_max_memory(tmp_path: Path) -> None:
    bomb = packed(*[bytes(1 << 20)] * 2048)
    assert len(bomb) < 1 << 20
    with pytest.raises(MemoryLimit, match="the decompressed file needs"):
        unpacked(bomb, limit=1 << 22)
    (tmp_path / "bad.svo.pb.zst").write_bytes(bomb)
    code = f"""if True:
        import resource, sys
        resource.setrlimit(resource.RLIMIT_AS, ({700 << 20}, {700 << 20}))
        from nerfbake.cli.main import run
        sys.exit(run(["info", "bad.svo.pb.zst", "--max-memory", "100MiB"]))"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "bad.svo.pb.zst: the decompressed file needs" in done.stderr


@pytest.mark.parametrize("form", [form for form in catalog.FORMATS if form.readable], ids=lambda form: form.name)
def test_nothing_compressed_is_an_empty_file(form: catalog.Format, tmp_path: Path) -> None:
    path = tmp_path / f"a{form.suffix}.zst"
    path.write_bytes(packed())
    (problem,) = check(path)
    assert problem.line.startswith("file is empty; allowed: ")
