"""Whatever a file holds: exit 1, one line, nothing written, soon, in little memory."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import build_octree, build_vdb, save
from nerfbake.cli.main import run
from tests.conftest import REPOSITORY
from tests.formats.field.test_n3tree import archive, svox
from tests.formats.octree.octrees import SPELLINGS
from tests.support.hostile import complaint
from tests.support.scenes import n3tree
from tests.support.vdb_readers import blosc_for_zip, bloscked

Arrays = dict[str, Any]


def good() -> Arrays:
    return svox(n3tree(splits=[(0, (0, 0, 0)), (1, (1, 1, 1))]))


def quantised() -> Arrays:
    arrays = {key: value for key, value in good().items() if key in ("child", "invradius3", "offset", "data_format")}
    shape = arrays["child"].shape
    arrays["quant_colors"] = np.zeros((1, 16, 3), np.float16)
    arrays["quant_map"] = np.zeros((1, *shape), np.uint16)
    return arrays | {"sigma": np.ones(shape, np.float16)}


def put(key: str, index: Any, value: Any) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[key] = np.array(arrays[key])
        arrays[key][index] = value

    return change


def replace(key: str, value: Any) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({key: value})


def drop(*keys: str) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        for key in keys:
            del arrays[key]

    return change


# n3tree.md's last section, line by line: what is changed, and what the one line has to name.
LIES = {
    "negative offset": (put("child", (1, 0, 0, 0), -3), "child[1, 0, 0, 0] points to node -2; allowed: 0 (no child)"),
    "zero-sum offsets": (put("child", (2, 0, 0, 0), -1), "child[2, 0, 0, 0] points to node 1; allowed: 0 (no child)"),
    "offset to the root": (put("child", (2, 0, 0, 0), -2), "child[2, 0, 0, 0] points to node 0; allowed"),
    "offset past the end": (put("child", (0, 1, 0, 0), 9), "child[0, 1, 0, 0] points to node 9; allowed"),
    "shared child": (put("child", (0, 1, 0, 0), 2), "points to node 2, as another cell does; allowed"),
    "no cells": (replace("child", np.zeros((3, 0, 0, 0), np.int32)), "child has shape (3, 0, 0, 0); allowed"),
    "one cell": (replace("child", np.zeros((3, 1, 1, 1), np.int32)), "child has shape (3, 1, 1, 1); allowed"),
    "no nodes": (replace("child", np.zeros((0, 2, 2, 2), np.int32)), "child has shape (0, 2, 2, 2); allowed"),
    "child is flat": (replace("child", np.zeros(24, np.int32)), "child has dtype int32, shape (24,); allowed"),
    "child is float": (replace("child", np.zeros((3, 2, 2, 2))), "child has dtype float64"),
    "child beyond int32": (replace("child", np.full((3, 2, 2, 2), 2**40)), "child"),
    "data too short": (replace("data", np.zeros((2, 2, 2, 2, 4), np.float16)), "data has shape (2, 2, 2, 2, 4)"),
    "data is one number": (replace("data", np.float16(1)), "data"),
    "data is whole": (replace("data", np.zeros((3, 2, 2, 2, 4), np.int64)), "data has dtype int64; allowed"),
    "data_dim disagrees": (replace("data_dim", np.int64(28)), "data_dim is 28; allowed: 4"),
    "data_format disagrees": (replace("data_format", np.array("SH9")), "data has 4 values per cell; allowed: 28"),
    "data_format unknown": (replace("data_format", np.array("\n\x1b[2J!")), "data_format is"),
    "NaN": (put("data", (2, 0, 1, 0, 1), np.nan), "data[2, 0, 1, 0, 1] is nan; allowed: a finite number"),
    "Inf": (put("data", (2, 0, 1, 0, 1), np.inf), "data[2, 0, 1, 0, 1] is inf; allowed: a finite number"),
    "NaN density": (put("data", (2, 0, 1, 0, 3), np.nan), "data[2, 0, 1, 0, 3] is nan; allowed: a finite"),
    "negative density": (put("data", (2, 0, 1, 0, 3), -1), "data[2, 0, 1, 0, 3] is -1; allowed: a density of 0"),
    "NaN invradius": (put("invradius3", 1, np.nan), "invradius[1] is nan; allowed: a finite number above 0"),
    "zero invradius": (put("invradius3", 2, 0), "invradius[2] is 0; allowed: a finite number above 0"),
    "infinite offset": (put("offset", 0, np.inf), "offset[0] is inf; allowed: a finite number"),
    "offset of two": (replace("offset", np.zeros(2, np.float32)), "offset has shape (2,); allowed: (3,)"),
    "missing keys": (drop("child", "offset"), "npz has no child, offset; allowed"),
    "nothing": (lambda arrays: arrays.clear(), "npz has no child"),
    "object array": (replace("data", np.array([{}, []], object)), "data holds Python objects (pickle); allowed"),
    "object scalar": (replace("data_format", np.array(None, object)), "data_format holds Python objects"),
    "complex data": (replace("data", np.zeros((3, 2, 2, 2, 4), complex)), "data has dtype <c16"),
}  # fmt: skip
QUANTISED_LIES = {
    "past the codebook": (put("quant_map", (0, 2, 0, 0, 1), 16), "quant_map[0, 2, 0, 0, 1] is 16; allowed: 0 to 15"),
    "codes of another tree": (replace("quant_map", np.zeros((1, 2, 2, 2, 2), np.uint16)), "quant_map has shape"),
    "too many codebooks": (replace("quant_colors", np.zeros((2, 16, 3), np.float16)), "quant_map has shape"),
    "no codebook": (replace("quant_colors", np.zeros((1, 0, 3), np.float16)), "quant_colors has shape (1, 0, 3)"),
    "grey codebook": (replace("quant_colors", np.zeros((1, 16), np.float16)), "quant_colors has shape (1, 16)"),
    "density of another tree": (replace("sigma", np.zeros((2, 2, 2, 2), np.float16)), "sigma has shape"),
    "missing": (drop("sigma"), "npz has no sigma"),
    "retained of another tree": (replace("data_retained", np.zeros((1, 3, 2, 2, 2, 1), np.float16)), "data_retained"),
    "too much retained": (replace("data_retained", np.zeros((3, 3, 2, 2, 2, 3), np.float16)), "1 codebooks beside 3"),
    "codes are floats": (replace("quant_map", np.zeros((1, 3, 2, 2, 2), np.float32)), "quant_map has dtype float32"),
}  # fmt: skip


def refused(tmp_path: Path, data: bytes, capfd: pytest.CaptureFixture[str], name: str = "bad.npz") -> str:
    """The one line that svo says over a file; check finds fault with it, too."""
    bad, out = tmp_path / name, tmp_path / "out.svo.pb"
    bad.write_bytes(data)
    assert complaint(["info", str(bad)], None) is None
    assert run(["check", str(bad)]) == 1
    assert name in capfd.readouterr().out
    assert run(["svo" if name.endswith("bad.npz") else "convert", str(bad), str(out)]) == 1
    said = capfd.readouterr()
    assert said.out == ""
    assert not list(tmp_path.glob("*out*"))
    (line,) = said.err.splitlines()
    assert line.startswith(f"error: {bad}: ")
    assert "allowed" in line
    assert line.isprintable()
    return line


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("deflated", [True, False])
def test_a_lying_tree_is_refused(lie: str, deflated: bool, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    arrays = good()
    change(arrays)
    assert expected in refused(tmp_path, archive(arrays, deflated=deflated), capfd)


@pytest.mark.parametrize("lie", QUANTISED_LIES)
def test_a_lying_quantised_tree_is_refused(lie: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, expected = QUANTISED_LIES[lie]
    arrays = quantised()
    change(arrays)
    assert expected in refused(tmp_path, archive(arrays), capfd)


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
    "no zip": (b"nonsense" * 100, "is no whole zip archive"),
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
    arrays = good()
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
    assert "bad.npz: data needs 170.9 MiB beside 172." in done.stderr  # KiB of the file and what it held before
    assert done.stderr.endswith(" that are taken; allowed: 100.0 MiB (--max-memory)\n")


def test_a_stream_that_goes_on_past_its_declared_end_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arrays = good()
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
    assert "data goes on past its declared end" in refused(tmp_path, packed.getvalue(), capfd)


def test_a_chain_of_nodes_ends_soon(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arrays = good()
    arrays["child"] = np.zeros((50_000, 2, 2, 2), np.int32)
    arrays["child"][:-1, 0, 1, 0] = 1
    arrays["data"] = np.zeros((50_000, 2, 2, 2, 4), np.float16)
    assert "leads to level 20; allowed: levels 0 to 19" in refused(tmp_path, archive(arrays), capfd)


DAMAGED: list[tuple[str, str, str | None]] = [("svo", "npz", None), ("svo", "stored.npz", None)]
DAMAGED += [("convert", name, profile) for name, profile in SPELLINGS]
DAMAGED += [("convert", "svo.pb.zst", "report"), ("convert", "svo.npz.zst", None)]
DAMAGED += [("convert", suffix, None) for suffix in ("vdb", "nvdb", "zip.nvdb", "vdb.npz", "blosc.vdb", "blosc.nvdb")]


@pytest.mark.slow
@pytest.mark.parametrize(("command", "suffix", "profile"), DAMAGED)
def test_damaged_files(command: str, suffix: str, profile: str | None, tmp_path: Path) -> None:
    """Cut at every 1 %, and 2,000 bit flips: exit 0 or 1, one line, under 5 s, under 3 GiB, nothing left behind."""
    tree = n3tree(splits=[(0, (0, 0, 0)), (0, (1, 0, 1)), (1, (1, 1, 1))], data_format="SH4")
    source = tmp_path / f"good.{suffix}"
    if command == "svo":
        source.write_bytes(archive(svox(tree), deflated=suffix == "npz"))
    elif "vdb" in suffix:
        grids = ("index",) if "nvdb" in suffix else ("density", "sh")
        codec: Any = {"codec": "zip"} if suffix == "zip.nvdb" else {}
        with blosc_for_zip() if suffix == "blosc.vdb" else nullcontext():
            save(source, build_vdb(build_octree(tree), grids=grids), **codec)
        if suffix == "blosc.nvdb":
            source.write_bytes(bloscked(source.read_bytes()))
    else:
        options: Any = {"profile": profile} if profile else {}
        save(source, build_octree(tree), **options)
    arguments = [sys.executable, "-m", "tests.support.hostile", command, str(source), "2000"]
    done = subprocess.run(arguments, cwd=REPOSITORY, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"bad.{suffix}", source.name]
