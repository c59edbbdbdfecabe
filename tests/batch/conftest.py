"""A folder to work in, where nerfbake's place is taken by a stub."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.batches import stub


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where tests stand; what they write goes into `in` and `out`."""
    command = stub(tmp_path)
    monkeypatch.setattr("nerfbake.jobs.batches.nerfbake_command", lambda: command)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    return tmp_path
