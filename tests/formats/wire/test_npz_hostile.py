"""Zip archives and arrays that lie: exit 1, one line, nothing written, soon, in little memory."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake.errors import InvalidFile
from nerfbake.formats.wire.npz import NpzReader
from tests.support.hostile import refused
from tests.support.n3trees import archive, sound


def member(name: str, content: bytes, file_size: int | None = None, **fields: Any) -> bytes:
    """A zip of one deflated member whose directory may lie about it."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
        info = archive.getinfo(name)
        for field, value in (fields if file_size is None else fields | {"file_size": file_size}).items():
            setattr(info, field, value)
    return file.getvalue()


def npy(header: str, body: bytes = b"") -> bytes:
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body


def declares(shape: str, descr: str = "'<f4'") -> str:
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"


ARCHIVES = {
    "an empty file": (b"", "is empty"),
    "no zip": (b"nonsense" * 100, "is not a complete zip archive"),
    "only a zip's end": (b"PK\x05\x06" + bytes(18), "npz has no child"),
    "terabytes, truly declared": (member("child.npy", npy(declares("(1000000, 1000000)", "'<i4'")), 1 << 40), "child"),
    "terabytes in the header": (member("child.npy", npy(declares("(1099511627776,)"))), "child declares shape"),
    "a negative shape": (member("child.npy", npy(declares("(-1, 2)"))), "child"),
    "a header that goes on": (member("child.npy", npy("x" * 20_000)), "child has a header of 20,000 bytes"),
    "a header of code": (member("child.npy", npy("__import__('os').system('true')")), "child has the header"),
    "a header of brackets": (member("child.npy", npy("(" * 5000)), "child has the header"),
    "no array": (member("child.npy", b"text" * 10), "child starts with"),
    "an empty member": (member("child.npy", b""), "child ends after 0 bytes"),
    "a record type": (member("child.npy", npy(declares("(1,)", "[('a', '<i4')]"), bytes(4))), "child has dtype"),
    "a wrong CRC": (member("child.npy", npy(declares("(1,)"), bytes(4)), CRC=1), "child"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARCHIVES)
def test_a_broken_archive_is_refused(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data, expected = ARCHIVES[name]
    if b"offset.npy" not in data and data[:2] == b"PK" and len(data) > 22:
        data = with_other_keys(data)
    assert expected in refused(tmp_path, data, capfd)


def test_a_directory_of_a_million_members_is_refused_before_it_is_unpacked() -> None:
    """It made 350 MB of a file of 35 MB, whatever --max-memory said."""
    entry = b"PK\1\2" + struct.pack("<4B4HL2L5H2L", 20, 0, 20, *[0] * 8, 1, *[0] * 6) + b"a"
    directory = entry * 200_000
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(directory), 30, 0)
    view = memoryview(b"PK\3\4" + bytes(26) + directory + end)
    tracemalloc.start()
    with pytest.raises(InvalidFile, match=r"zip directory has 9,400,000 bytes; allowed: 1,048,576 at most"):
        NpzReader(view)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def with_other_keys(broken: bytes) -> bytes:
    """The broken member first, then the other keys that a tree must have, so that reading gets as far as it."""
    file = io.BytesIO(broken)
    with zipfile.ZipFile(file, "a") as target:
        for key in ("offset", "invradius3", "data"):
            content = io.BytesIO()
            np.save(content, np.zeros(3, np.float32))
            target.writestr(f"{key}.npy", content.getvalue())
    return file.getvalue()


def test_a_member_that_inflates_a_thousandfold_stays_within_max_memory(tmp_path: Path) -> None:
    arrays = sound()
    arrays["data"] = np.zeros((400_000, 2, 2, 2, 28), np.float16)
    data = archive(arrays)
    assert arrays["data"].nbytes > 900 * len(data)
    (tmp_path / "bad.npz").write_bytes(data)
    code = f"""if True:
        import resource, sys
        resource.setrlimit(resource.RLIMIT_AS, ({600 << 20}, {600 << 20}))
        from nerfbake.cli.main import run
        sys.exit(run(["svo", "bad.npz", "out.svo.pb", "--max-memory", "100MiB"]))"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "bad.npz: data needs 170.9 MiB in addition to 172." in done.stderr  # KiB of the file and what it held before
    assert done.stderr.endswith(" in use; allowed: 100.0 MiB (--max-memory)\n")


def test_a_stream_that_goes_on_past_its_declared_end_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arrays = sound()
    file = io.BytesIO(archive(arrays))
    content = io.BytesIO()
    np.save(content, arrays["data"])
    with zipfile.ZipFile(file) as whole:
        others = {name: whole.read(name) for name in whole.namelist() if name != "data.npy"}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target:
        for name, body in others.items():
            target.writestr(name, body)
        target.writestr("data.npy", content.getvalue() + bytes(1000))
        target.getinfo("data.npy").file_size = len(content.getvalue())
        target.getinfo("data.npy").CRC = zlib.crc32(content.getvalue())
    assert "data continues past its declared end" in refused(tmp_path, packed.getvalue(), capfd)
