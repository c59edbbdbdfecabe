"""A lock file says whose it is, and is given back by whoever has it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from nerfbake.errors import OutputError
from nerfbake.io.locks import occupied


def test_nobody_else_gets_in_while_somebody_is_at_work(tmp_path: Path) -> None:
    lock = tmp_path / "state" / "lock"
    with occupied(lock):
        with pytest.raises(OutputError) as caught, occupied(lock):
            pass
        said = f"process {os.getpid()} on {socket.gethostname()} is at work; allowed: to wait for it, or --take-over"
        assert str(caught.value) == f"{lock}: {said}"
    assert not lock.exists()


def test_what_a_dead_process_has_left_is_told_and_taken_over(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    dead = f"""if True:
        import os
        from nerfbake.io.locks import occupied
        with occupied({str(lock)!r}):
            os._exit(0)"""
    subprocess.run([sys.executable, "-c", dead], check=True)
    with pytest.raises(OutputError, match=r"was left behind by process .* which is gone; allowed: --take-over"):
        occupied(lock).__enter__()
    with occupied(lock, take_over=True):
        assert str(os.getpid()) in lock.read_text()
    assert not lock.exists()


@pytest.mark.parametrize("content", [b"", b"no json", b"[]", b'{"pid": "x", "host": 1}', b"\xff" * 10_000])
def test_a_lock_that_says_nothing_is_a_lock(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "lock").write_bytes(content)
    with pytest.raises(OutputError, match="somebody is at work"):
        occupied(tmp_path / "lock").__enter__()


def test_a_lock_that_was_taken_over_is_not_removed_by_who_had_it(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    with occupied(lock):
        lock.write_text("another's")
    assert lock.read_text() == "another's"
