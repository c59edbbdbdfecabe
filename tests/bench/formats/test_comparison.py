from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import save
from nerfbake.bench.formats import comparison
from nerfbake.bench.formats.comparison import PAPER, compare_formats
from nerfbake.bench.measure import Result, measure
from nerfbake.cli.main import run
from nerfbake.console import Console
from nerfbake.scene.octree import SparseVoxelOctree
from tests.bench.conftest import quiet
from tests.conftest import Shell
from tests.support.octrees import small_octree
from tests.support.outputs import read_output
from tests.support.scenes import n3tree


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_the_report_has_a_row_for_everything_and_its_ratios_add_up() -> None:
    report = compare_formats(small_octree(), "small", rounds=2, formats=["svo.pb", "json.dumps"], progress=quiet)
    figures = report.tables[0]
    rows = {row[0]: dict(zip(figures.columns, row, strict=True)) for row in figures.rows}
    assert list(rows) == ["raw", "svo.pb report", "svo.pb bulk", "svo.pb.zst report", "json.dumps"]
    octree = small_octree()
    assert rows["raw"]["MB"] == (octree.node_children.nbytes + octree.node_data.nbytes) / 1e6
    for row in rows.values():
        assert row["exact"] is True
        assert row["encode ms"].low <= row["encode ms"].median <= row["encode ms"].high
        assert row["encode x raw"] == pytest.approx(row["encode ms"].median / rows["raw"]["encode ms"].median)
        assert row["size x raw"] == pytest.approx(row["MB"] / rows["raw"]["MB"])
    assert (rows["svo.pb bulk"]["encode ms"].rounds, rows["json.dumps"]["encode ms"].rounds) == (2, 1)
    assert "Python" in report.head
    assert any("BinaryFormatter" in row for row in report.tables[1].rows)
    assert any("Microsoft withdrew" in note for note in report.notes)


def test_a_missing_library_is_a_row_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_pycapnp(function: Any, **arguments: Any) -> Any:
        if arguments["row"].name.startswith("pycapnp"):
            return Result(error="not installed: capnp")
        return measure(function, **arguments)

    monkeypatch.setattr(comparison, "measure", without_pycapnp)
    report = compare_formats(small_octree(), "small", rounds=1, formats=["pycapnp, Data"], progress=quiet)
    assert report.tables[0].rows[1] == ["pycapnp, Data: not installed: capnp", *[None] * 9]


@pytest.mark.usefixtures("in_this_process")
def test_the_papers_figures_stand_beside_a_comparable_scene_only() -> None:
    assert PAPER not in compare_formats(small_octree(), "s", rounds=1, formats=["raw"], progress=quiet).tables
    values = np.zeros((1, 20_000_000), np.float32)
    large = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), values)
    assert PAPER in compare_formats(large, "large", rounds=1, formats=["raw"], progress=quiet).tables


@pytest.mark.usefixtures("in_this_process")
def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))]))
    save(tmp_path / "b.svo.pb", small_octree())
    options = ["--formats", "svo.fb", "--rounds", "1"]
    assert run(["bench", "formats", "a.npz", "b.svo.pb", "--resolution", "2", *options, "--format", "json"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    reports = read_output("bench", printed.out)["reports"]
    assert [report["head"]["scene"].partition(",")[0] for report in reports] == [
        "a.npz: SH1 octree of 2x2x2",
        "b.svo.pb: SH4 octree of 4x4x4",
    ]
    assert run(["bench", "formats", "b.svo.pb", *options, "-o", "c.md", "--plot", "c.svg"]) == 0
    assert tuple(capsys.readouterr()) == ("", "")
    assert "| svo.fb bulk |" in (tmp_path / "c.md").read_text()
    assert "svo.fb bulk" in (tmp_path / "c.svg").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["a.svo.pb", "--formats", "xml"], 2, "no format is called 'xml'; allowed: raw, svo.npz, "),
        (["a.svo.pb", "--plot", "a.pdf"], 2, "the extension of 'a.pdf' is not that of a chart; allowed: .png, .svg"),
        (["a.svo.pb", "-o", "a.svo.pb"], 4, "a.svo.pb: exists already; allowed: a new file, or --force"),
        (["nothing.svo.pb"], 1, "nothing.svo.pb: No such file"),
    ],
)
def test_wrong_usage_is_said_before_anything_is_measured(
    arguments: list[str], code: int, said: str, tmp_path: Path, shell: Shell
) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    done = shell("bench", "formats", *arguments)
    assert (done.returncode, done.stdout) == (code, b"")
    (line,) = done.stderr.decode().splitlines()
    assert said in line


def test_a_terminal_sees_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    steps: list[str] = []

    def phase(_: Console, text: str) -> Any:
        steps.append(text)
        return nullcontext()

    monkeypatch.setattr(Console, "phase", phase)
    arguments = ["bench", "formats", str(tmp_path / "a.svo.pb"), "--formats", "raw", "--rounds", "1"]
    assert run([*arguments, "-o", str(tmp_path / "a.md")]) == 0
    assert steps[-2:] == ["raw: warming up", "raw: round 1 of 1"]
