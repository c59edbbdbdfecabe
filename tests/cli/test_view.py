"""`nerfbake view`, as a shell sees it."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import Cameras, N3Tree, build_field, build_octree, load, orbit_cameras, save
from nerfbake import sample_n3tree as made_tree
from tests.conftest import Shell
from tests.support.scenes import n3tree


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", made_tree(resolution=16, basis="SH4"))
    return tmp_path / "a.npz"


@pytest.mark.usefixtures("scene")
def test_a_page_is_written_and_kept(shell: Shell, tmp_path: Path) -> None:
    done = shell("view", "a.npz", "a.html")
    assert done.returncode == 0, done.stderr
    assert b"<title>a.npz</title>" in (tmp_path / "a.html").read_bytes()
    assert "predicted on 24 views" in done.stderr.decode()
    assert shell("view", "a.npz", "a.html").returncode == 4
    done = shell("view", "-", "-", "--title", "<b>", stdin=(tmp_path / "a.npz").read_bytes())
    assert done.returncode == 0, done.stderr
    assert b"<title>&lt;b&gt;</title>" in done.stdout


@pytest.mark.usefixtures("scene")
def test_a_size_is_that_of_the_page(shell: Shell, tmp_path: Path) -> None:
    done = shell("view", "a.npz", "a.html", "--max-size", "140kB")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.html").stat().st_size <= 140_000
    assert shell("view", "a.npz", "b.html", "--max-size", "9kB").returncode == 3
    assert not (tmp_path / "b.html").exists()


@pytest.mark.usefixtures("scene")
def test_exact_data_and_cameras(shell: Shell, tmp_path: Path) -> None:
    octree = build_octree(load(tmp_path / "a.npz", N3Tree))
    field = build_field(octree)
    save(tmp_path / "c.json", Cameras(orbit_cameras(field, frames=3, width=30, height=20).cameras))
    save(tmp_path / "a.svo.pb", octree)
    options = ("--data", "exact", "--cameras", "c.json", "--background", "255,0,0")
    done = shell("view", "a.svo.pb", "a.html", *options)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "a.html").read_text()
    assert '"turns": false' in page
    assert '"background": [1.0, 0.0, 0.0]' in page
    assert page.count('"pose"') == 3
    assert "float16" not in done.stderr.decode()  # what is float16 loses nothing


@pytest.mark.usefixtures("scene")
def test_what_float16_loses_is_told(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "b.svo.npz", build_octree(load(tmp_path / "a.npz", N3Tree), resolution=8))
    done = shell("view", "b.svo.npz", "b.html", "--data", "exact")
    assert done.returncode == 0, done.stderr
    assert "dB from its float32" in done.stderr.decode()


@pytest.mark.usefixtures("scene")
def test_what_cannot_be_asked_for(shell: Shell, tmp_path: Path) -> None:
    for options, line in (
        (["--max-loss", "1", "--max-size", "1MB"], "--max-loss and --max-size are two goals"),
        (["--data", "exact", "--max-loss", "1"], "--max-loss has no effect on exact data"),
    ):
        done = shell("view", "a.npz", "a.html", *options)
        assert done.returncode == 2
        assert line in done.stderr.decode()
    assert shell("view", "a.npz", "a.png").returncode == 2
    save(tmp_path / "g.npz", n3tree(data_format="SG2"))
    done = shell("view", "g.npz", "g.html")
    assert done.returncode == 1
    assert done.stderr.decode() == "error: g.npz: data_format is SG2; allowed: SHk or RGBA can be rendered\n"
