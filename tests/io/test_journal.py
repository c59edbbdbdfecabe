"""Lines that outlive whoever writes them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from nerfbake.errors import OutputError
from nerfbake.io.journal import Journal, read_journal


def test_lines_come_back_in_their_order(tmp_path: Path) -> None:
    for number in range(2):
        journal = Journal(tmp_path / "deep" / "a.jsonl")
        journal.write({"number": number, "name": "\udcff\n"})
        journal.close()
    found = list(read_journal(tmp_path / "deep" / "a.jsonl"))
    assert found == [{"number": number, "name": "\udcff\n"} for number in range(2)]
    assert list(read_journal(tmp_path / "none")) == []


@pytest.mark.parametrize("kept", range(0, 12, 3))
def test_a_torn_line_is_no_line_and_swallows_no_other(kept: int, tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"a":1}\n' + b'{"torn":true}'[:kept])
    journal = Journal(path)
    journal.write({"b": 2})
    journal.close()
    assert list(read_journal(path)) == [{"a": 1}, {"b": 2}]


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "a.jsonl")
    with open("/dev/full", "wb", buffering=0) as full:
        os.dup2(full.fileno(), journal._file.fileno())
    with pytest.raises(OutputError, match=r"a.jsonl: No space left on device"):
        journal.write({"a": 1})
    journal.close()


def test_a_line_too_long_to_be_ours_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.io.journal._LONGEST", 16)
    (tmp_path / "a.jsonl").write_bytes(b'{"a":1}\n{"long":"' + b"x" * 100 + b'"}\n{"exactly":3456}\n{"b":2}')
    assert list(read_journal(tmp_path / "a.jsonl")) == [{"a": 1}, {"b": 2}]


def test_a_link_or_a_pipe_in_place_of_a_journal_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").write_bytes(b'{"a":1}\n')
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "new")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "dangling", "pipe"):
        for use in (Journal, lambda path: list(read_journal(path))):
            with pytest.raises(OutputError, match=f"{name}: is "):
                use(tmp_path / name)
    assert (tmp_path / "mine").read_bytes() == b'{"a":1}\n'
    assert not (tmp_path / "new").exists()
