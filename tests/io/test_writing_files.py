"""Files appear whole or not at all."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nerfbake import build_octree, catalog, io, load, sample_n3tree, save
from nerfbake.errors import InvalidFile, OutputError, UsageError
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conftest import Shell
from tests.support.scenes import assert_same_octree, n3tree


@pytest.fixture
def octree() -> SparseVoxelOctree:
    return build_octree(n3tree(splits=[(0, (1, 0, 1))]))


@pytest.mark.parametrize("suffix", [".svo.pb", ".svo.npz"])
def test_what_is_saved_is_loaded(octree: SparseVoxelOctree, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    assert save(path, octree) == path.stat().st_size
    assert_same_octree(load(path, SparseVoxelOctree), octree)
    assert [path.name for path in tmp_path.iterdir()] == [path.name]


def test_an_existing_file_is_replaced_only_with_force(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    path = tmp_path / "a.svo.pb"
    path.write_bytes(b"old")
    with pytest.raises(OutputError, match=r"a\.svo\.pb: exists already; allowed: .*`force`"):
        save(path, octree)
    assert path.read_bytes() == b"old"
    save(path, octree, force=True)
    assert_same_octree(load(path), octree)


def test_a_failed_write_leaves_the_old_file(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    path = tmp_path / "a.svo.pb"
    path.write_bytes(b"old")

    def half_of_it() -> Iterator[bytes]:
        yield b"half of the n"
        raise RuntimeError

    with pytest.raises(RuntimeError), io.replacing(path, force=True) as file:
        file.writelines(half_of_it())
    assert path.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == [path.name]


def test_permissions_are_those_of_any_new_file(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    save(tmp_path / "a.svo.pb", octree)
    (tmp_path / "b").touch()
    assert (tmp_path / "a.svo.pb").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_a_link_is_followed_not_replaced(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "a.svo.pb").symlink_to(tmp_path / "real" / "b.svo.pb")
    with pytest.raises(OutputError):
        save(tmp_path / "a.svo.pb", octree)
    save(tmp_path / "a.svo.pb", octree, force=True)
    assert (tmp_path / "a.svo.pb").is_symlink()
    assert_same_octree(load(tmp_path / "real" / "b.svo.pb"), octree)


def test_a_fifo_is_written_to_not_replaced(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    received: list[bytes] = []
    reader = threading.Thread(target=lambda: received.append(fifo.read_bytes()))
    reader.start()
    save(fifo, octree, to="svo.pb")
    reader.join()
    assert stat.S_ISFIFO(fifo.stat().st_mode)
    save(tmp_path / "a.svo.pb", octree)
    assert received[0] == (tmp_path / "a.svo.pb").read_bytes()


def test_places_that_cannot_be_written_are_named(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"nowhere/a\.svo\.pb: its folder .*/nowhere does not exist"):
        save(tmp_path / "nowhere" / "a.svo.pb", octree)
    (tmp_path / "folder.svo.pb").mkdir()
    with pytest.raises(OutputError, match=r"folder\.svo\.pb"):
        save(tmp_path / "folder.svo.pb", octree, force=True)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_an_error(octree: SparseVoxelOctree) -> None:
    with pytest.raises(OutputError, match="/dev/full: No space left on device"):
        save("/dev/full", octree, to="svo.pb")


@pytest.mark.long
def test_a_killed_write_leaves_the_old_file_or_none(shell: Shell, tmp_path: Path) -> None:
    shell("sample", "octree", "a.npz", "--resolution", "64")
    assert shell("svo", "a.npz", "good.svo.pb").returncode == 0
    good = (tmp_path / "good.svo.pb").read_bytes()
    command = [sys.executable, "-m", "nerfbake", "svo", "a.npz", "b.svo.pb", "--force"]
    survived = killed = 0
    for attempt in range(12):
        target = tmp_path / "b.svo.pb"
        if attempt % 2:
            target.write_bytes(b"old")
        else:
            target.unlink(missing_ok=True)
        process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL)
        # Most attempts strike once the temporary file is there: in the middle of the write.
        limit = time.perf_counter() + 10
        while attempt % 4 and process.poll() is None and time.perf_counter() < limit:
            if list(tmp_path.glob(".b.svo.pb.*")):
                break
        if not attempt % 4:
            time.sleep(0.03 * attempt)
        process.send_signal(signal.SIGKILL)
        killed += process.wait() == -signal.SIGKILL
        content = target.read_bytes() if target.exists() else None
        survived += content == good
        assert content in (good, b"old" if attempt % 2 else None)
        for left in tmp_path.glob(".b.svo.pb.*"):
            left.unlink()
    assert killed


def test_sigterm_and_ctrl_c_clean_up(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "a.npz", sample_n3tree(resolution=64))
    command = [sys.executable, "-m", "nerfbake", "svo", "a.npz", "fifo", "--to", "svo.pb"]
    os.mkfifo(tmp_path / "fifo")
    for number, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE) as process:
            reader = os.open(tmp_path / "fifo", os.O_RDONLY)  # opens once the writer does
            os.read(reader, 10)
            process.send_signal(number)
            assert process.wait(timeout=20) == code
            assert process.stderr is not None
            assert b"Traceback" not in process.stderr.read()
            os.close(reader)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "fifo"]


def test_the_wrong_kind_of_scene_is_refused(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    save(tmp_path / "a.svo.npz", octree)
    with pytest.raises(InvalidFile, match=r"holds an octree \(.*as a volume\); allowed: a PlenOctree"):
        load(tmp_path / "a.svo.npz", N3Tree)


def test_a_renamed_file_is_told_by_its_bytes(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    for suffix in (".svo.npz", ".svo.pb"):
        save(tmp_path / f"a{suffix}", octree)
    (tmp_path / "a.svo.npz").rename(tmp_path / "b.npz")
    (tmp_path / "a.svo.pb").rename(tmp_path / "b.bin")
    for name in ("b.npz", "b.bin"):
        assert_same_octree(load(tmp_path / name, SparseVoxelOctree), octree)
    (tmp_path / "c.bin").write_bytes(b"\x00" * 600)
    with pytest.raises(InvalidFile, match="starts with 00 00"):
        load(tmp_path / "c.bin")


def test_a_format_must_be_known(octree: SparseVoxelOctree, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"an octree cannot be written as 'obj'; allowed: svo\.npz, svo\.pb"):
        save(tmp_path / "a.svo.pb", octree, to="obj")
    with pytest.raises(UsageError, match=r"is that of svo\.pb, but `to` is svo\.fb; allowed: one of them"):
        save(tmp_path / "a.svo.pb", octree, to="svo.fb")
    with pytest.raises(UsageError, match="has no file extension"):
        save(tmp_path / "a.obj", octree)


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(tmp_path / f"{name}.npz", sample_n3tree(resolution=32))
        save(tmp_path / f"{name}.svo.pb", build_octree(load(tmp_path / f"{name}.npz", N3Tree)))
    for suffix in (".npz", ".svo.pb"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_a_forward_facing_scene_is_known_by_its_companion(tmp_path: Path) -> None:
    save(tmp_path / "fern.npz", n3tree())
    assert not load(tmp_path / "fern.npz", N3Tree).ndc
    np.save(tmp_path / "fern_poses_bounds.npy", np.zeros((1, 17)))
    assert load(tmp_path / "fern.npz", N3Tree).ndc


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 132735\n"


@pytest.mark.parametrize("suffix", [form.suffix for form in catalog.FORMATS if form.readable] + ["", ".npz.zst"])
def test_a_git_lfs_pointer_is_called_by_its_name(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(POINTER)
    with pytest.raises(InvalidFile, match="is a Git-LFS pointer, not the file itself; allowed: the file, which"):
        load(path)


def test_a_git_lfs_pointer_in_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "mlp.json").write_bytes(POINTER)
    with pytest.raises(InvalidFile, match=r"mlp\.json: is a Git-LFS pointer"):
        load(tmp_path)


def test_swapped_arguments_are_told(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"the path comes first: save\('a\.npz', scene\)"):
        io.save(sample_n3tree(resolution=8), "a.npz")  # type: ignore[arg-type]
