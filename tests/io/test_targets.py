"""Outputs: whole or not at all, whoever else writes them and whoever dies meanwhile."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from nerfbake.errors import BudgetMissed, OutputError
from nerfbake.io import targets
from nerfbake.io.own_files import lock
from nerfbake.io.own_folders import FolderContents
from nerfbake.io.targets import replacing, replacing_files, replacing_folder, require_absent, require_no_folder

OWN = FolderContents("the tests' a", re.compile("a"), lambda files: True)  # folders with one file, a

# Writes half of what it should under the target's name, says so, and waits to be killed.
HALF_WRITER = """
import sys, time
from pathlib import Path
from nerfbake.io.targets import replacing, replacing_folder
from tests.io.test_targets import OWN
target = Path(sys.argv[1])
if target.suffix:
    with replacing(target, force=True) as file:
        file.write(b"half")
        file.flush()
        print("ready", flush=True)
        time.sleep(60)
else:
    with replacing_folder(target, OWN, force=True) as folder:
        (folder / "a").write_bytes(b"half")
        print("ready", flush=True)
        time.sleep(60)
"""


def half_writer(target: Path) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", HALF_WRITER, str(target)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def write(target: Path, content: bytes) -> None:
    with replacing(target, force=True) as file:
        file.write(content)


def write_folder(target: Path, content: bytes) -> None:
    with replacing_folder(target, OWN, force=True) as folder:
        (folder / "a").write_bytes(content)


def test_what_a_killed_writer_left_is_swept_by_the_next_one(tmp_path: Path) -> None:
    for target in (tmp_path / "out.bin", tmp_path / "folder"):
        with half_writer(target) as process:
            process.send_signal(signal.SIGKILL)
        assert not target.exists()
        assert len(list(tmp_path.iterdir())) == 1
        (write if target.suffix else write_folder)(target, b"whole")
        assert [path.name for path in tmp_path.iterdir()] == [target.name]
        assert (target if target.suffix else target / "a").read_bytes() == b"whole"
        (write if target.suffix else write_folder)(target, b"again")
        assert [path.name for path in tmp_path.iterdir()] == [target.name]
        target.unlink() if target.suffix else shutil.rmtree(target)


def test_what_a_living_writer_is_writing_is_left_alone(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    with half_writer(target) as process:
        write(target, b"whole")
        assert len(list(tmp_path.iterdir())) == 2  # the other's part is there still
        process.kill()
    assert target.read_bytes() == b"whole"


def test_leftovers_of_other_targets_and_other_peoples_files_are_left_alone(tmp_path: Path) -> None:
    others = [".out.bin.0123456789abcdef.part.bak", ".other.0123456789abcdef.part", ".out.bin.xyz.part", "out.bin.part"]
    for name in others:
        (tmp_path / name).write_bytes(b"mine")
    write(tmp_path / "out.bin", b"whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, "out.bin"])


def test_two_writers_of_one_target_do_not_meet(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    contents = [bytes([i]) * 100_000 for i in range(8)]

    def work(content: bytes) -> None:
        for _ in range(25):
            write(target, content)
            assert target.read_bytes() in contents

    threads = [threading.Thread(target=work, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert target.read_bytes() in contents
    assert [path.name for path in tmp_path.iterdir()] == ["out.bin"]


def require_own_folder(target: Path, *, force: bool) -> None:
    require_no_folder(target, OWN, force=force)


def no_links(part: Path, target: Path) -> None:
    raise OSError("Operation not supported")


@pytest.mark.parametrize("links", [True, False])
def test_what_another_process_wrote_in_the_meantime_is_replaced_with_force_only(
    links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not links:
        monkeypatch.setattr("os.link", no_links)
    target = tmp_path / "a"

    def write(*, force: bool) -> None:
        with replacing(target, force=force) as file:
            file.write(b"mine")
            target.write_bytes(b"another's")

    if links:
        with pytest.raises(OutputError, match="was written by another process; allowed: a new file, or `force`"):
            write(force=False)
        assert target.read_bytes() == b"another's"
    write(force=True)
    assert target.read_bytes() == b"mine"
    target.unlink()
    with replacing(target, force=False) as file:
        file.write(b"new")
    assert target.read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_what_another_process_wrote_into_a_folder_is_replaced_with_force_only(tmp_path: Path) -> None:
    target = tmp_path / "folder"

    def write(name: str, *, force: bool) -> None:
        with replacing_folder(target, OWN, force=force) as folder:
            (folder / "a").write_bytes(b"mine")
            target.mkdir(exist_ok=True)
            (target / name).write_bytes(b"another's")

    with pytest.raises(OutputError, match="was written by another process; allowed: a new or empty folder, or `force`"):
        write("a", force=False)
    assert (target / "a").read_bytes() == b"another's"
    write("a", force=True)
    assert (target / "a").read_bytes() == b"mine"
    with pytest.raises(OutputError, match="has 'b', which nerfbake did not write"):
        write("b", force=True)
    assert {path.name: path.read_bytes() for path in target.iterdir()} == {"a": b"mine", "b": b"another's"}
    shutil.rmtree(target)
    target.mkdir()  # an empty folder is replaced
    with replacing_folder(target, OWN, force=False) as folder:
        (folder / "a").write_bytes(b"new")
    assert (target / "a").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_of_many_writers_of_a_new_folder_one_succeeds(tmp_path: Path) -> None:
    target, ready, won = tmp_path / "folder", threading.Barrier(8, timeout=60), []

    def work(number: int) -> None:
        with suppress(OutputError):
            with replacing_folder(target, OWN, force=False) as folder:
                (folder / "a").write_text(str(number))
                ready.wait()
            won.append(str(number))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert won == [(target / "a").read_text()]
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_of_two_writers_of_a_file_with_others_beside_it_one_succeeds(tmp_path: Path) -> None:
    target = tmp_path / "a.obj"

    def write(names: list[str], content: str) -> None:
        with replacing_files(target, names, force=False) as folder:
            for name in names:
                (folder / name).write_text(content)
            if content == "first":
                write(["a.obj", "a.jpg", "a.mtl"], "second")

    with pytest.raises(OutputError, match=r"a\.mtl: was written by another process"):
        write(["a.obj", "a.png", "a.mtl"], "first")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ["a.obj", "a.jpg", "a.mtl"], "second"
    )


def test_a_rejected_folder_beside_a_link_to_another_file_system_is_moved_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "real").mkdir()
    (tmp_path / "out").symlink_to("far/real")
    rename = Path.rename

    def apart(path: Path, target: Path) -> Path:
        if path.parent != Path(target).parent:
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", apart)
    for content in ("1", "2"):
        with suppress(BudgetMissed), replacing_folder(tmp_path / "out", OWN, force=True) as folder:
            (folder / "a").write_text(content)
            raise BudgetMissed("too bad")
        assert (tmp_path / "out.rejected" / "a").read_text() == content
    assert sorted(path.name for path in tmp_path.iterdir()) == ["far", "out", "out.rejected"]
    assert [path.name for path in (tmp_path / "far").iterdir()] == ["real"]


@pytest.mark.parametrize("folder", [False, True])
def test_a_broken_link_is_told_and_force_is_not_advised(folder: bool, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to("nowhere")
    require = require_own_folder if folder else require_absent
    with pytest.raises(OutputError) as error:
        require(link, force=False)
    assert str(error.value) == f"{link}: is a broken link to nowhere; allowed: a new {'folder' if folder else 'file'}"
    with pytest.raises(OutputError, match=r"is behind .*link, a broken link to nowhere"):
        require_absent(link / "a.bin", force=False)
    if not folder:
        write(link, b"whole")  # with force, as before: the file that the link names
        assert (tmp_path / "nowhere").read_bytes() == b"whole"


def test_a_folder_is_there_whole_at_every_moment(tmp_path: Path) -> None:
    target, done, seen = tmp_path / "folder", threading.Event(), set()
    write_folder(target, b"0")

    def watch() -> None:
        while not done.is_set():
            seen.add((target / "a").read_bytes())  # would raise if the folder were gone

    errors: list[BaseException] = []

    def guarded() -> None:
        try:
            watch()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=guarded)
    thread.start()
    for turn in range(100):
        write_folder(target, str(turn).encode())
    done.set()
    thread.join()
    assert not errors
    assert seen


def test_without_an_exchange_the_old_folder_comes_back_if_the_writer_dies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "folder"
    write_folder(target, b"old")
    monkeypatch.setattr(targets, "_exchange", lambda a, b: False)
    write_folder(target, b"new")
    assert (target / "a").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
    # The writer dies after it has moved the old folder aside: its part and the old one are what is left.
    target.rename(tmp_path / ".folder.0123456789abcdef.old")
    (tmp_path / ".folder.0123456789abcdef.part").mkdir()
    with pytest.raises(KeyboardInterrupt), replacing_folder(target, OWN, force=True):
        raise KeyboardInterrupt
    assert (target / "a").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_where_there_are_no_locks_nothing_is_swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(handle: int, how: int) -> None:
        raise OSError("no locks here")

    monkeypatch.setattr("fcntl.flock", no_locks)
    another = tmp_path / ".out.bin.0123456789abcdef.part"
    another.write_bytes(b"half")  # whoever writes it may be alive
    write(tmp_path / "out.bin", b"whole")
    assert (tmp_path / "out.bin").read_bytes() == b"whole"
    assert another.exists()


@pytest.mark.parametrize("moment", ["open", "lock"])
@pytest.mark.parametrize("folder", [False, True])
def test_a_part_that_a_sweeper_took_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str, folder: bool
) -> None:
    taken: list[Path] = []

    def sweep() -> None:
        for part in () if taken else tmp_path.iterdir():
            taken.append(part)
            part.rmdir() if folder else part.unlink()

    def open_swept(path: Path, *arguments: int, open_it: Callable[..., int] = os.open) -> int:
        sweep()
        return open_it(path, *arguments)

    def lock_swept(handle: int) -> bool | None:
        sweep()
        return lock(handle)

    monkeypatch.setattr(*((os, "open", open_swept) if moment == "open" else (targets, "lock", lock_swept)))
    target = tmp_path / "out"
    write_folder(target, b"whole") if folder else write(target, b"whole")
    assert len(taken) == (folder or moment == "lock")  # a file is made and opened in one step
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_force_keeps_the_mode(tmp_path: Path) -> None:
    for name, mode in (("a.bin", 0o600), ("b.bin", 0o755)):
        write(tmp_path / name, b"old")
        (tmp_path / name).chmod(mode)
        write(tmp_path / name, b"new")
        assert stat.S_IMODE((tmp_path / name).stat().st_mode) == mode
    write_folder(tmp_path / "folder", b"old")
    (tmp_path / "folder").chmod(0o700)
    write_folder(tmp_path / "folder", b"new")
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o700


def test_a_new_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    write(tmp_path / "out.bin", b"")
    (tmp_path / "plain").touch()
    assert (tmp_path / "out.bin").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_name_of_255_bytes_is_written(tmp_path: Path) -> None:
    target = tmp_path / ("ä" * 120 + "x" * 11 + ".bin")
    assert len(os.fsencode(target.name)) == 255
    write(target, b"whole")
    assert target.read_bytes() == b"whole"


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "real.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to(tmp_path / "folder" / "real.bin")
    write(tmp_path / "link.bin", b"new")
    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "folder" / "real.bin").read_bytes() == b"new"


@pytest.mark.parametrize("target", ["folder", "a\0b.bin"])
def test_what_is_no_name_of_a_file_is_refused(target: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError), replacing(tmp_path / target, force=True):
        pass


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("none/a.bin", "its folder .*none does not exist; allowed: an existing folder"),
        ("file/a.bin", "Not a directory"),
        ("dangling", "is a broken link to none/a.bin; allowed: a new file"),
        ("loop", "symbolic links"),
        ("x" * 256, "too long"),
    ],
)
def test_a_place_where_nothing_can_be_written_is_told_before_the_work(name: str, found: str, tmp_path: Path) -> None:
    """It was told when the work was done, which was then lost: of a fit minutes, its OUT.partial included."""
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "dangling").symlink_to("none/a.bin")
    (tmp_path / "loop").symlink_to("loop")
    for require in (require_absent, require_own_folder)[: 1 if name in ("dangling", "loop") else 2]:
        with pytest.raises(OutputError, match=found):
            require(tmp_path / name, force=True)
    if name.startswith("none"):
        require_absent(tmp_path / name, force=False, parents=True)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc, where not even root can create a file")
@pytest.mark.parametrize("require", [require_absent, require_own_folder])
def test_a_folder_that_nobody_may_write_to_is_told_before_the_work(require: Callable[..., None]) -> None:
    with pytest.raises(OutputError, match=r"^/proc/a.bin: (No such file|Permission denied)"):
        require("/proc/a.bin", force=False)


def test_looking_for_a_place_leaves_nothing(tmp_path: Path) -> None:
    require_absent(tmp_path / "a.bin", force=False)
    require_no_folder(tmp_path / "a", OWN, force=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_random_kills_leave_nothing_half(tmp_path: Path) -> None:
    target = tmp_path / "out.bin"
    writer = "import sys; from pathlib import Path; from tests.io.test_targets import write\nwhile True: "
    writer += "write(Path(sys.argv[1]), bytes([65]) * 10_000_000)"
    for turn in range(20):
        process = subprocess.Popen([sys.executable, "-c", writer, str(target)])
        time.sleep(0.3 + 0.013 * turn)
        process.kill()
        process.wait()
        assert not target.exists() or target.read_bytes() == b"A" * 10_000_000
    write(target, b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["out.bin"]
