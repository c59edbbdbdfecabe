"""`nerfbake compare`, and budgets right after writing, as a shell sees them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nerfbake import N3Tree, SparseVoxelOctree, build_field, load, orbit_cameras, save
from tests.conftest import Shell
from tests.support.scenes import n3tree


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    return tmp_path / "a.npz"


@pytest.mark.usefixtures("tree_file")
def test_a_budget_that_holds_and_one_that_does_not(shell: Shell, tmp_path: Path) -> None:
    assert shell("svo", "a.npz", "good.svo.pb", "--min-psnr", "50").returncode == 0
    assert (tmp_path / "good.svo.pb").exists()
    done = shell("svo", "a.npz", "bad.svo.pb", "--resolution", "1", "--min-psnr", "50")
    assert done.returncode == 3
    assert done.stderr.decode().splitlines()[-1].startswith("error: bad.svo.pb: the picture has a mean PSNR of ")
    assert not (tmp_path / "bad.svo.pb").exists()
    assert load(tmp_path / "bad.svo.pb.rejected", SparseVoxelOctree).problems() == []
    assert shell("lod", "good.svo.pb", "l.svo.pb", "--level", "0", "--min-psnr", "50").returncode == 3
    assert (tmp_path / "l.svo.pb.rejected").exists()
    assert shell("svo", "a.npz", "-", "--to", "svo.pb", "--min-psnr", "50").returncode == 2


@pytest.mark.usefixtures("tree_file")
def test_volumes_have_budgets_too(shell: Shell, tmp_path: Path) -> None:
    field = build_field(load(tmp_path / "a.npz", N3Tree))
    save(tmp_path / "c.json", orbit_cameras(field, frames=2, width=24, height=20))
    budget = ["--cameras", "c.json", "--min-psnr", "50"]
    assert shell("vdb", "a.npz", "good.nvdb", "--grids", "index", *budget).returncode == 0
    assert shell("compare", "a.npz", "good.nvdb", "--cameras", "c.json", "--min-psnr", "60").returncode == 0
    assert shell("vdb", "a.npz", "grey.vdb", "--grids", "density", *budget).returncode == 3
    assert sorted(path.name for path in tmp_path.glob("*vdb*")) == ["good.nvdb", "grey.vdb.rejected"]
    # Judged in the octree's own world, although the file stands in another.
    assert shell("vdb", "a.npz", "turned.nvdb", "--grids", "index", "--up", "y", *budget).returncode == 0


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
        (["--html", "-"], 2, "stdout has the figures; allowed for --sheet and --html: a file"),
        (["--sheet", "-"], 2, "stdout has the figures; allowed for --sheet and --html: a file"),
        (["--html", "page.txt"], 2, "has no ending that a page of a comparison is written with; allowed: .html"),
        (["--html", "none/page.html", "--size", "9x9"], 4, "none/page.html: No such file or directory"),
        (["--html", "page.html", "--max-memory", "1MB"], 1, "that are taken; allowed: 976.6 KiB (--max-memory)"),
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
def test_a_page_is_nothing_to_read(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("<!DOCTYPE html>")
    done = shell("info", "page.html")
    assert done.returncode == 1
    assert done.stderr.startswith(b"error: page.html: starts with 3c 21 44 4f 43 54 59 50, as no known format does")


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
