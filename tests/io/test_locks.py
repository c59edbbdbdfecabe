"""A lock file says whose it is; the kernel says whether that process lives."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from nerfbake.errors import OutputError
from nerfbake.io import own_files
from nerfbake.io.locks import occupied


def owner(pid: int, host: str) -> str:
    return json.dumps({"pid": pid, "host": host})


def test_no_other_process_gets_in_while_one_is_at_work(tmp_path: Path) -> None:
    lock = tmp_path / "state" / "lock"
    with occupied(lock):
        for _ in range(2):  # a refusal must not give the lock back
            with pytest.raises(OutputError) as caught, occupied(lock):
                pass
        said = f"is in use by process {os.getpid()} on {socket.gethostname()}; allowed: to wait for it, or `take_over`"
        assert str(caught.value) == f"{lock}: {said}"
    assert not lock.exists()


def test_what_a_killed_process_has_left_is_replaced(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    dead = f"""if True:
        import os
        from nerfbake.io.locks import occupied
        with occupied({str(lock)!r}):
            os.kill(os.getpid(), 9)"""
    assert subprocess.run([sys.executable, "-c", dead], check=False).returncode == -9
    assert lock.exists()
    with occupied(lock):
        assert lock.read_text() == owner(os.getpid(), socket.gethostname())
    assert not lock.exists()


def test_a_living_process_that_has_the_number_of_a_dead_one_is_not_taken_for_it(tmp_path: Path) -> None:
    (tmp_path / "lock").write_text(owner(os.getppid(), socket.gethostname()))
    with occupied(tmp_path / "lock"):
        pass


def test_a_lock_of_another_host_has_to_be_taken_over(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    lock.write_text(owner(4_000_000, "elsewhere"))
    with pytest.raises(OutputError, match=r"is in use by process 4000000 on elsewhere; allowed: .*`take_over`"):
        occupied(lock).__enter__()
    assert lock.read_text() == owner(4_000_000, "elsewhere")
    with occupied(lock, take_over=True):
        assert str(os.getpid()) in lock.read_text()
    assert not lock.exists()


@pytest.mark.parametrize("content", [b"no json", b"[]", b'{"pid": "x", "host": 1}', b"[" * 4096, b'{"pid":1e999}'])
def test_a_lock_that_says_nothing_is_a_lock(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "lock").write_bytes(content)
    with pytest.raises(OutputError, match="is in use by another process"):
        occupied(tmp_path / "lock").__enter__()


def test_a_lock_whose_writer_was_killed_before_it_wrote_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "lock").touch()
    with occupied(tmp_path / "lock"):
        pass


def test_where_there_are_no_locks_of_the_system_the_file_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_files, "fcntl", None)
    with occupied(tmp_path / "lock"):
        with pytest.raises(OutputError, match="is in use"):
            occupied(tmp_path / "lock").__enter__()
        with occupied(tmp_path / "lock", take_over=True):
            pass


def test_a_lock_that_was_taken_over_is_not_removed_by_the_process_that_had_it(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    with occupied(lock):
        other = occupied(lock, take_over=True)
        other.__enter__()
    assert lock.exists()
    other.__exit__(None, None, None)
    assert not lock.exists()


def test_a_link_in_place_of_a_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "lock").symlink_to(tmp_path / "mine")
    for take_over in (False, True):
        with pytest.raises(OutputError, match="lock: is a symbolic link; allowed: a regular file"):
            occupied(tmp_path / "lock", take_over=take_over).__enter__()
    assert (tmp_path / "mine").read_text() == "mine"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="pipe: is not a regular file"):
        occupied(tmp_path / "pipe").__enter__()
