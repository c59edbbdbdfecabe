"""Pages that draw splats, from files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Camera, Cameras, PageSplats, Splats, save
from nerfbake.errors import BudgetMissed, UsageError
from nerfbake.io import load_page_content
from nerfbake.jobs import splat_pages, view_splats
from nerfbake.jobs.splats import SplatsOptions, SplatsViews
from nerfbake.scene.camera import look_at
from tests.jobs.listener import Listener
from tests.support.splats import splats


@pytest.fixture
def scene(folder: Path) -> Splats:
    scene = replace(splats(60, degree=1), up=None)
    save(folder / "s.ply", scene)
    return scene


@pytest.mark.usefixtures("scene")
def test_a_page_keeps_the_world_and_tells_the_loss(listener: Listener) -> None:
    page = view_splats("s.ply", "s.html", min_psnr=40, title="A name", steps=listener)
    assert (page.title, page.turns, str(page)) == ("A name", True, "page of 60 splats of SH degree 1")
    assert any("rounded for the page, " in line for line in listener.said)
    assert any("dB against s.ply" in line for line in listener.said)
    found = load_page_content("s.html")
    assert isinstance(found, PageSplats)
    assert found.up is None  # -y, as without a page


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_up_is_that_of_the_cameras_if_the_file_does_not_say(folder: Path, scene: Splats, up: str) -> None:
    axis = np.roll(np.eye(3), "xyz".index(up[-1]) - 2, axis=1) * (-1 if up[0] == "-" else 1)
    poses = [look_at(np.zeros(3), turn, 0.3, 9.0, axis) for turn in range(3)]
    save(folder / "c.json", Cameras(tuple(Camera(16, 16, 20.0, pose) for pose in poses)))
    page = view_splats("s.ply", "s.html", cameras="c.json")
    assert isinstance(page.content, PageSplats)
    assert page.content.up == up
    assert not page.turns
    save(folder / "stated.ply", replace(scene, up="z"))
    stated = view_splats("stated.ply", "t.html", cameras="c.json").content
    assert isinstance(stated, PageSplats)
    assert stated.up == "z"


@pytest.mark.usefixtures("scene")
def test_a_missed_limit_leaves_a_rejected_page(folder: Path) -> None:
    with pytest.raises(BudgetMissed):
        view_splats("s.ply", "s.html", min_psnr=99)
    assert (folder / "s.html.rejected").exists()
    assert not (folder / "s.html").exists()


def test_photographs_need_their_capture(folder: Path) -> None:
    with pytest.raises(UsageError, match="`photographs` needs `cameras`"):
        view_splats("s.ply", "s.html", photographs=True)
    assert not (folder / "s.html").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_a_field_becomes_splats(listener: Listener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splat_pages, "SplatsViews", lambda: SplatsViews(frames=4, edge=24))
    monkeypatch.setattr(splat_pages, "SplatsOptions", lambda: SplatsOptions(epochs=1))
    page = view_splats("a.npz", "a.html", steps=listener)
    assert isinstance(page.content, PageSplats)
    assert page.content.up == "z"
    assert any("fits splats to 4 pictures" in line for line in listener.said)
