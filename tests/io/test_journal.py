"""Lines that outlive whoever writes them."""

from __future__ import annotations

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
    journal = Journal("/dev/full")
    with pytest.raises(OutputError, match="/dev/full: No space left on device"):
        journal.write({"a": 1})
    journal.close()
