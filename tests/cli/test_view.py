"""`nerfbake view`, as a shell sees it."""

from __future__ import annotations

import base64
import sys
from pathlib import Path

import pytest

from nerfbake import Cameras, N3Tree, build_field, build_octree, build_vdb, load, orbit_cameras, render_field, save
from nerfbake import sample_n3tree as made_tree
from tests.conftest import Shell
from tests.support.scenes import n3tree
from tests.support.splats import splats

pytestmark = pytest.mark.usefixtures("fewer_rays")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", made_tree(resolution=8, basis="SH1"))
    return tmp_path / "a.npz"


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_a_page_is_written_and_kept(shell: Shell, tmp_path: Path) -> None:
    done = shell("view", "a.npz", "a.html")
    assert done.returncode == 0, done.stderr
    assert b"<title>a</title>" in (tmp_path / "a.html").read_bytes()
    assert "predicted on 24 views" in done.stderr.decode()
    assert shell("view", "a.npz", "a.html").returncode == 4
    done = shell("view", "-", "-", "--title", "<b>", stdin=(tmp_path / "a.npz").read_bytes())
    assert done.returncode == 0, done.stderr
    assert b"<title>&lt;b&gt;</title>" in done.stdout


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_a_size_is_that_of_the_page(shell: Shell, tmp_path: Path) -> None:
    done = shell("view", "a.npz", "a.html", "--max-size", "200kB")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.html").stat().st_size <= 200_000
    assert shell("view", "a.npz", "b.html", "--max-size", "9kB").returncode == 3
    assert not (tmp_path / "b.html").exists()


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_what_is_compressed_already_is_carried_as_it_is(shell: Shell, tmp_path: Path) -> None:
    assert shell("compress", "a.npz", "a.svoq", "--step", "0.1").returncode == 0
    packed = base64.b64encode((tmp_path / "a.svoq").read_bytes())
    done = shell("view", "a.svoq", "a.html", "--min-psnr", "30")
    assert done.returncode == 0, done.stderr
    said = "a.svoq: already compressed, so the page carries it unchanged\n"
    assert said in done.stderr.decode()
    assert b'id="data">' + packed + b"</script>" in (tmp_path / "a.html").read_bytes()
    # Whoever names a goal has it compressed anew.
    done = shell("view", "a.svoq", "b.html", "--max-loss", "3")
    assert done.returncode == 0, done.stderr
    assert said not in done.stderr.decode()
    assert packed not in (tmp_path / "b.html").read_bytes()


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
    save(tmp_path / "b.svo.npz", build_octree(load(tmp_path / "a.npz", N3Tree), resolution=4))
    done = shell("view", "b.svo.npz", "b.html", "--data", "exact")
    assert done.returncode == 0, done.stderr
    assert "dB against its float32" in done.stderr.decode()


@pytest.mark.usefixtures("scene")
def test_what_cannot_be_asked_for(shell: Shell, tmp_path: Path) -> None:
    for options, line in (
        (["--max-loss", "1", "--max-size", "1MB"], "--max-loss and --max-size are two goals"),
        (["--data", "exact", "--max-loss", "1"], "--max-loss has no effect with --data exact"),
        (["--samples", "2"], "--samples has no effect without --truth or --min-psnr"),
    ):
        done = shell("view", "a.npz", "a.html", *options)
        assert done.returncode == 2
        assert line in done.stderr.decode()
    assert shell("view", "a.npz", "a.png").returncode == 2
    save(tmp_path / "g.npz", n3tree(data_format="SG2"))
    done = shell("view", "g.npz", "g.html")
    assert done.returncode == 1
    assert done.stderr.decode() == "error: g.npz: data_format is SG2; allowed: SHk or RGBA can be rendered\n"


@pytest.mark.usefixtures("scene")
def test_a_volume_is_shown_as_it_is_and_says_so(shell: Shell, tmp_path: Path) -> None:
    octree = build_octree(load(tmp_path / "a.npz", N3Tree))
    save(tmp_path / "a.vdb.npz", build_vdb(octree, grids=("density", "sh")))
    done = shell("view", "a.vdb.npz", "a.html", "--min-psnr", "60")
    assert done.returncode == 0, done.stderr
    assert b"a.vdb.npz: volumes are not compressed, so the page carries its values in float16" in done.stderr
    assert '"kind": "arrays"' in (tmp_path / "a.html").read_text()
    assert b"dB against a.vdb.npz" in done.stderr
    for options in (["--data", "compressed"], ["--max-size", "1MB"]):
        done = shell("view", "a.vdb.npz", "b.html", *options)
        assert done.returncode == 2
        assert b"a.vdb.npz is a volume, which cannot be compressed; allowed: --data exact" in done.stderr
    done = shell("view", "-", "-", stdin=(tmp_path / "a.vdb.npz").read_bytes())
    assert done.returncode == 0, done.stderr
    assert b"<title>stdin</title>" in done.stdout


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_a_page_that_shows_too_little_is_rejected(shell: Shell, tmp_path: Path) -> None:
    done = shell("view", "a.npz", "a.html", "--min-psnr", "99")
    assert done.returncode == 3
    assert done.stderr.decode().splitlines()[-1].startswith("error: a.html: the picture has a mean PSNR of")
    assert not (tmp_path / "a.html").exists()
    assert (tmp_path / "a.html.rejected").exists()
    done = shell("view", "a.npz", "-", "--min-psnr", "9")
    assert done.returncode == 2
    assert b"--min-psnr needs an output file" in done.stderr


@pytest.mark.usefixtures("scene")
def test_the_loss_is_measured_where_there_are_photographs(shell: Shell, tmp_path: Path) -> None:
    field = build_field(load(tmp_path / "a.npz", N3Tree))
    views = orbit_cameras(field, frames=2, width=40, height=40)
    save(tmp_path / "c.json", Cameras(views.cameras))
    for camera in views.cameras:
        save(tmp_path / "photographs" / f"{camera.name}.png", render_field(field, camera), parents=True)
    done = shell("view", "a.npz", "a.html", "--truth", "photographs")
    assert done.returncode == 2
    assert b"--truth has no cameras" in done.stderr
    done = shell("view", "a.npz", "a.html", "--truth", "photographs", "--cameras", "c.json", "--max-loss", "3")
    assert done.returncode == 0, done.stderr
    assert b"measured on 2 views" in done.stderr


BROWSER = (
    "import shutil, sys, urllib.request\nshutil.copy(urllib.request.url2pathname(sys.argv[1][7:]), 'opened.html')\n"
)


@pytest.mark.usefixtures("scene")
def test_without_out_a_browser_opens_the_page(shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "browser.py").write_text(BROWSER)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "kept"))
    (tmp_path / "kept").mkdir()
    done = shell("view", "a.npz")
    assert done.returncode == 2
    assert b"there is no display for a browser; allowed: an OUT, which you can open on another machine" in done.stderr
    monkeypatch.setenv("BROWSER", f"{sys.executable} browser.py %s")
    done = shell("view", "a.npz", "--data", "exact")
    assert done.returncode == 0, done.stderr
    assert b"<title>a</title>" in (tmp_path / "opened.html").read_bytes()
    assert len(list((tmp_path / "kept").glob("nerfbake-*/page.html"))) == 1
    # What fails leaves nothing behind, and options of a file are refused where there is none.
    assert shell("view", "a.npz", "--min-psnr", "200", "--data", "exact").returncode == 3
    assert len(list((tmp_path / "kept").glob("nerfbake-*"))) == 1
    assert b"--force has no effect without OUT" in shell("view", "a.npz", "--force").stderr
    monkeypatch.setenv("BROWSER", f"{sys.executable} missing.py %s")
    done = shell("view", "a.npz", "--data", "exact")
    assert done.returncode == 2
    assert b"no browser could open " in done.stderr


def test_splats_are_drawn_as_splats_if_asked(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "s.ply", splats(20, degree=0))
    done = shell("view", "s.ply", "s.html", "--as", "splats", "--background", "0,0,0")
    assert done.returncode == 0, done.stderr
    assert b'"kind": "splats"' in (tmp_path / "s.html").read_bytes()
    for options in (["--data", "exact"], ["--lookup", "trilinear"], ["--max-size", "1MB"], ["--mesh", "s.ply"]):
        done = shell("view", "s.ply", "t.html", "--as", "splats", *options)
        assert done.returncode == 2
        assert f"{options[0]} has no effect with --as splats" in done.stderr.decode()
        assert not (tmp_path / "t.html").exists()
    assert shell("view", "s.ply", "t.html", "--as", "mesh").returncode == 2
