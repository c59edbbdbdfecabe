"""Pages from files: how large they are when nobody says."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest

from nerfbake import sample_n3tree, save
from nerfbake.errors import UsageError
from nerfbake.jobs import CompressionGoal, compress_file, view_file
from tests.jobs.listener import Listener

pytestmark = pytest.mark.usefixtures("fewer_rays")


def test_a_page_without_a_goal_has_a_most_and_says_what_that_loses(
    folder: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    save("a.npz", sample_n3tree(resolution=8, basis="SH1"), force=True)
    view_file("a.npz", "free.html")
    most = compress_file("a.npz", "a.svoq").size * 3 // 4
    monkeypatch.setattr("nerfbake.jobs.pages._MOST_BYTES", most)
    view_file("a.npz", "a.html", steps=listener)
    assert 0.95 * most <= svoq_size(folder / "a.html") <= most
    told = f"a.html: the compressed data are limited to {most / 1e6:g} MB by default; "
    assert f"{told}`max_loss=0.1` makes a larger page" in listener.said
    view_file("a.npz", "b.html", goal=CompressionGoal(max_loss=0.1))
    assert (folder / "b.html").stat().st_size == (folder / "free.html").stat().st_size


def test_a_scene_that_is_too_large_for_any_step_still_has_a_page(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save("a.npz", sample_n3tree(resolution=8, basis="SH1"), force=True)
    view_file("a.npz", "free.html")
    monkeypatch.setattr("nerfbake.jobs.pages._MOST_BYTES", 100)
    view_file("a.npz", "a.html")
    assert (folder / "a.html").stat().st_size == (folder / "free.html").stat().st_size


def svoq_size(page: Path) -> int:
    """Bytes of the compressed octree that a page carries."""
    data = re.search(rb'id="data">([^<]*)</script>', page.read_bytes())
    assert data is not None
    return len(base64.b64decode(data[1]))


def test_photographs_need_their_capture(folder: Path) -> None:
    with pytest.raises(UsageError, match="`photographs` needs `cameras`"):
        view_file("a.npz", "a.html", photographs=True)
    assert not (folder / "a.html").exists()
