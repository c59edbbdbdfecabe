"""Inputs: read whole, whatever happens to them meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from nerfbake import load, memory_limit, sample_n3tree, save
from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.io import load_folder, sources
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.stage1 import Stage1


def test_a_file_that_is_cut_short_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(3 << 20))
    make_room = sources._room

    def cut(size: int) -> memoryview:
        os.truncate(path, 1 << 20)
        return make_room(size)

    monkeypatch.setattr(sources, "_room", cut)
    with pytest.raises(InvalidFile, match="was truncated to 1,048,576 bytes"):
        sources.read_file(path)


def test_a_file_that_is_cut_short_at_any_moment_kills_nobody(tmp_path: Path) -> None:
    # What a mapped file did: SIGBUS, the process dies without a word.
    good = tmp_path / "good.npz"
    save(good, sample_n3tree(resolution=32, basis="SH1"))
    content, path, done = good.read_bytes(), tmp_path / "a.npz", threading.Event()
    path.write_bytes(content)

    def cut() -> None:
        while not done.is_set():
            os.truncate(path, 4096)
            path.write_bytes(content)

    thread = threading.Thread(target=cut)
    thread.start()
    code = """if True:
        import sys
        from nerfbake.cli.main import run
        sys.stdout = None  # what check finds is not what is asked
        codes = {run(["info", "a.npz"]) for _ in range(200)}
        sys.exit(not codes <= {1, 4})"""
    finished = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    done.set()
    thread.join()
    assert finished.returncode == 0, finished
    assert all(line.startswith("error: ") for line in finished.stderr.splitlines())


def test_files_of_every_size_are_read_whole(tmp_path: Path) -> None:
    for size in (0, 1, sources._HUGE - 1, sources._HUGE, sources._HUGE + 1):
        content = os.urandom(size)
        (tmp_path / "a.bin").write_bytes(content)
        view = sources.read_file(tmp_path / "a.bin")
        assert view.readonly
        assert bytes(view) == content


def test_a_file_counts_as_memory(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(bytes(5000))
    with memory_limit(4999), pytest.raises(MemoryLimit, match=r"a\.npz: the file needs 4\.9 KiB; allowed: 4\.9 KiB"):
        load(tmp_path / "a.npz")


def test_an_endless_stream_ends_at_the_limit() -> None:
    with memory_limit(10 << 20), pytest.raises(MemoryLimit, match="the stream needs"):
        load("/dev/zero")


def test_a_folders_files_are_read_once(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"one")
    folder = sources.Folder(tmp_path, {"b": memoryview(b"two")})
    first = folder["a"]
    (tmp_path / "a").write_bytes(b"changed")
    assert folder["a"] is first
    assert sorted(folder) == ["a", "b"]
    assert "c" not in folder
    with pytest.raises(KeyError):
        folder["c"]


def test_the_head_of_a_file_is_its_first_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"three")
    folder = sources.Folder(tmp_path, {"b": memoryview(b"more")})
    assert [folder.head(name, 3) for name in ("a", "b", "c", ".")] == [b"thr", b"mor", b"", b""]
    assert folder.head("a", 99) == b"three"


def test_loaded_scenes_count_for_as_long_as_they_live(tmp_path: Path) -> None:
    tree = sample_n3tree(resolution=32)
    save(tmp_path / "a.npz", tree)
    size = tree.child.nbytes + tree.data.nbytes
    with memory_limit(3 * size):
        first = load(tmp_path / "a.npz", N3Tree)
        with pytest.raises(MemoryLimit, match="in use"):
            _ = [load(tmp_path / "a.npz", N3Tree) for _ in range(3)]
        del first
        load(tmp_path / "a.npz", N3Tree)
        load(tmp_path / "a.npz", N3Tree)


def test_a_broken_link_is_told_as_one(tmp_path: Path) -> None:
    (tmp_path / "link.npz").symlink_to("gone/a.npz")
    (tmp_path / "folder").symlink_to("gone")
    for name, told in (
        ("link.npz", r"link\.npz: is a broken link to gone/a\.npz; allowed: an existing file or folder"),
        ("folder", r"folder: is a broken link to gone; allowed: "),
        ("folder/a.npz", r"folder/a\.npz: is behind .*/folder, a broken link to gone; allowed: "),
        ("none.npz", r"none\.npz: No such file or directory$"),
    ):
        with pytest.raises(InvalidFile, match=told):
            load(tmp_path / name)
    with pytest.raises(InvalidFile, match=r"folder: is a broken link to gone; allowed: a folder"):
        load_folder(tmp_path / "folder", Stage1)
