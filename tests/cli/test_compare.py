"""`nerfbake compare` as a shell sees it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from nerfbake import N3Tree, build_field, load, orbit_cameras, save
from nerfbake.cli.main import run
from tests.cli.telling import told
from tests.conftest import Shell


@pytest.mark.usefixtures("tree_file")
def test_compare(shell: Shell, tmp_path: Path) -> None:
    assert shell("svo", "a.npz", "b.svo.pb", "--resolution", "2").returncode == 0
    done = shell("compare", "a.npz", "b.svo.pb", "--size", "40x30", "--sheet", "sheet.png", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert len(told["views"]) == 8
    assert 5 < told["mean"]["a_b"]["psnr"] < 60
    assert (tmp_path / "sheet.png").stat().st_size > 100
    done = shell("compare", "a.npz", "b.svo.pb", "--size", "40x30", "--max-error", "0")
    assert done.returncode == 3
    assert done.stdout.decode().splitlines()[-6].startswith("mean        IN - IN2")
    assert "b.svo.pb: the picture is off by" in done.stderr.decode()


@pytest.mark.usefixtures("tree_file")
def test_a_page_with_every_figure_is_there_even_where_the_budget_is_missed(shell: Shell, tmp_path: Path) -> None:
    evil = "<script>alert(1)<" + "&.svo.npz"
    assert shell("svo", "a.npz", evil, "--resolution", "2").returncode == 0
    arguments = ["compare", "a.npz", evil, "--size", "20x16", "--json", "--html", "cost.html", "--min-psnr", "90"]
    done = shell(*arguments)
    assert done.returncode == 3
    told = json.loads(done.stdout)
    page = (tmp_path / "cost.html").read_text()
    for part in (told["mean"]["a_b"], told["values"]["sigma"], told["bytes"], *(view["a_b"] for view in told["views"])):
        for value in part.values():
            assert f'<data value="{value!r}">' in page
    assert "Budget missed" in page
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)&lt;&amp;.svo.npz" in page
    # Nothing is replaced without being told to, and then nothing is printed either.
    done = shell(*arguments)
    assert (done.returncode, done.stdout) == (4, b"")
    assert done.stderr.decode().startswith("error: cost.html: exists already")
    done = shell(*arguments, "--force")
    assert (done.returncode, (tmp_path / "cost.html").read_text()) == (3, page)


@pytest.mark.usefixtures("tree_file")
def test_sizes_are_what_was_read(shell: Shell, tmp_path: Path) -> None:
    size = (tmp_path / "a.npz").stat().st_size
    piped = (tmp_path / "a.npz").read_bytes()
    told = json.loads(shell("compare", "-", "a.npz", "--size", "9x9", "--json", stdin=piped).stdout)
    assert told["bytes"] == {"a": size, "b": size}
    lines = shell("compare", "a.npz", "a.npz", "--size", "9x9").stdout.decode().splitlines()
    assert lines[-2:] == [f"bytes       IN            {size:,}", f"bytes       IN2           {size:,}"]


@pytest.mark.usefixtures("tree_file")
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--html", "-"], 2, "--sheet and --html cannot be stdout, which gets the figures; allowed: a file"),
        (["--sheet", "-"], 2, "--sheet and --html cannot be stdout, which gets the figures; allowed: a file"),
        (["--html", "page.txt"], 2, "has no file extension for a page of a comparison; allowed: .html"),
        (["--html", "none/page.html", "--size", "9x9"], 4, "none/page.html: its folder none does not exist"),
        (["--html", "page.html", "--max-memory", "1MB"], 1, "in use; allowed: 976.6 KiB (--max-memory)"),
    ],
)
def test_a_page_that_cannot_be_is_one_line(
    shell: Shell, tmp_path: Path, arguments: list[str], code: int, said: str
) -> None:
    done = shell("compare", "a.npz", "a.npz", *arguments)
    (line,) = done.stderr.decode().splitlines()
    assert said in line
    assert done.returncode == code
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.usefixtures("tree_file")
def test_truth_from_a_folder(shell: Shell, tmp_path: Path) -> None:
    tree = load(tmp_path / "a.npz", N3Tree)
    save(tmp_path / "cameras.json", orbit_cameras(build_field(tree), frames=2, width=24, height=20))
    assert shell("render", "a.npz", "--cameras", "cameras.json", "--all", "--out", "truth").returncode == 0
    done = shell("compare", "a.npz", "a.npz", "--cameras", "cameras.json", "--truth", "truth", "--json")
    told = json.loads(done.stdout)
    assert told["mean"]["a_b"]["psnr"] == 100
    assert told["mean"]["a_truth"]["psnr"] > 50  # but for the rounding to 8 bits
    (tmp_path / "truth" / "0001.png").unlink()
    done = shell("compare", "a.npz", "a.npz", "--cameras", "cameras.json", "--truth", "truth")
    assert (done.returncode, done.stderr) == (1, b"error: truth/0001.png: No such file or directory\n")


@pytest.mark.usefixtures("tree_file")
def test_reports_say_how_many_rays_a_pixel_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    tree = load("a.npz", N3Tree)
    views = orbit_cameras(build_field(tree), frames=2, width=24, height=20)
    save("cameras.json", replace(views, samples=2))
    assert run(["svo", "a.npz", "b.svo.pb", "--resolution", "2"]) == 0
    lines = ["compare", "a.npz", "b.svo.pb", "--cameras", "cameras.json"]
    found = set()
    for samples, more in ((2, []), (1, ["--samples", "1"]), (3, ["--samples", "3"])):
        facts = told([*lines, *more, "--html", f"{samples}.html"], capsys)
        assert facts["samples"] == samples
        assert (f", {samples}x{samples} rays a pixel" in Path(f"{samples}.html").read_text()) == (samples > 1)
        found.add(facts["mean"]["a_b"]["psnr"])
        assert run([*lines, *more, "-q"]) == 0
        last = capsys.readouterr().out.splitlines()[-1].split()
        assert last == ["rays", "a", "pixel", f"{samples}x{samples}"] or (samples == 1 and last[0] == "bytes")
    assert len(found) == 3
    # Pictures and their truth through the same filter are the same but for 8 bits.
    assert run(["render", "a.npz", "--cameras", "cameras.json", "--all", "--out", "truth", "-q"]) == 0
    lines = ["compare", "a.npz", "a.npz", "--cameras", "cameras.json", "--truth", "truth"]
    same, other = (told([*lines, *more], capsys)["mean"]["a_truth"]["psnr"] for more in ([], ["--samples", "1"]))
    assert same > 50 > other


def test_an_atlas_against_the_mlp_in_pictures(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [str(sample / "in"), str(sample / "out")]
    sheet = sample / "sheet.png"
    errors = told(["compare", *folders, "--size", "48x48", "--sheet", str(sheet)], capsys)["mean"]["a_b"]
    assert 25 < errors["psnr"] < 60
    assert sheet.stat().st_size > 1000
    assert told(["compare", folders[0], folders[0], "--size", "48x48"], capsys)["mean"]["a_b"]["psnr"] == 100
    assert run(["compare", *folders, "--size", "48x48", "--min-psnr", "90"]) == 3
    # Of the mesh inside scene.glb only the diffuse look is shown: it is further off than the atlas.
    flat = told(["compare", folders[0], str(sample / "out" / "scene.glb"), "--size", "48x48"], capsys)["mean"]["a_b"]
    assert flat["psnr"] < errors["psnr"] - 3


def test_an_atlas_without_its_mesh_says_so(sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(sample / "out", tmp_path / "out")
    (tmp_path / "out" / "mesh_0.obj").unlink()
    assert run(["compare", str(sample / "in"), str(tmp_path / "out"), "--size", "8x8"]) == 1
    assert f"error: {tmp_path}/out: mesh_0.obj is missing" in capsys.readouterr().err
