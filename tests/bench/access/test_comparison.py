from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import build_octree, sample_n3tree, save
from nerfbake.bench.access import comparison, readers
from nerfbake.bench.access.comparison import chart_access, compare_access, figures
from nerfbake.bench.access.readers import READERS, kinds_of_points, structure_named
from nerfbake.bench.measure import Result, Statistics
from nerfbake.bench.report import markdown
from nerfbake.cli.main import run
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.octree import SparseVoxelOctree
from tests.bench.access.conftest import POINTS
from tests.bench.conftest import quiet
from tests.conftest import Shell
from tests.support.octrees import small_octree
from tests.support.outputs import read_output
from tests.support.scenes import n3tree

NANOVDB = ("NanoVDB C++", "NanoVDB C++, no stencil cache")


def test_what_does_not_fit_is_a_row_that_says_so(folder: Path) -> None:
    with pytest.raises(MemoryLimit, match=r"it needs 877.5 KiB; allowed: 500.0 KiB \(`memory_limit`\)"):
        structure_named("dense array", folder, 13, 500 << 10)
    tree = sample_n3tree(resolution=32)
    tree.require_sound()  # which takes memory of its own, once
    with memory_limit(1 << 12):
        report = compare_access(tree, "s", resolutions=[32], rounds=1, progress=quiet)
    ((said, R, *others),) = report.tables[0].rows
    assert said.startswith("all: ")
    assert "--max-memory" in said
    assert (R, set(others)) == (32, {None})


def test_a_wrong_sum_would_be_seen_and_ratios_are_to_the_faster_nanovdb() -> None:
    rows = {reader.name: reader for reader in READERS}

    def found(ns: float, total: float) -> list[Result]:
        return [Result(facts={"found": [[ns, total, 100.0]] * 4, "bytes": 1_000_000, "version": ""})]

    cells = figures(
        8,
        {
            (rows["VDB"], 1): found(10, 7.1),
            (rows["VDB index"], 1): found(12, 7.0),
            (rows[NANOVDB[0]], 1): found(50, 7.0005),
            (rows[NANOVDB[1]], 1): found(40, 7.0),
        },
    )
    assert [row[-1] for row in cells] == [False, True, True, True]
    assert [row[7] for row in cells] == [0.25, 0.3, 1.25, 1.0]
    assert cells[0][3:7] == [Statistics(10, 10, 10, 1)] * 4


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_the_report_and_its_chart(octree: SparseVoxelOctree, monkeypatch: pytest.MonkeyPatch) -> None:
    some = tuple(row for row in READERS if row.name in ("VDB", "VDB index", "OpenVDB C++"))
    monkeypatch.setattr(comparison, "READERS", some)
    camera = Camera(40, 40, 40.0, np.eye(4), "a")
    report = compare_access(octree, "s", resolutions=None, rounds=2, progress=quiet, cameras=[camera], points=POINTS)
    reads, rays, files = report.tables
    rows = [dict(zip(reads.columns, row, strict=True)) for row in reads.rows]
    assert [(row["structure"].partition(":")[0], row["R"], row["channels"]) for row in rows] == [
        ("VDB", 32, 1),
        ("VDB index", 32, 1),
        ("OpenVDB C++", 32, 1),
        ("VDB index", 32, 13),
    ]
    assert all(row["sums agree"] is True and row["MB"] > 0 for row in rows if row["MB"] is not None)
    assert rows[0]["surface ns"].rounds == 2
    assert rays.rows[0][1:3] == [1, "total"]
    assert all(size > 0 for _, _, size in files.rows)
    assert {what.split()[0] for what, _, _ in files.rows} == {"octree", "density", "index"}
    assert "| VDB index |" in markdown(report)
    assert b"VDB index" in chart_access(report, ".svg")


def test_a_scene_without_a_voxel_is_refused() -> None:
    empty = build_octree(n3tree(splits=[], data_format="SH4"), sigma_min=1e9)
    with pytest.raises(InvalidScene, match="the scene has no voxel; allowed: a density above 0"):
        compare_access(empty, "s", resolutions=None, rounds=1, progress=quiet)


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(readers, "kinds_of_points", lambda size, topology, _: kinds_of_points(size, topology, POINTS))
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))]))
    save(tmp_path / "rays.json", Cameras((Camera(8, 8, 8.0, np.eye(4), "a"),)))
    out, plot = tmp_path / "out.json", tmp_path / "out.svg"
    arguments = [str(tmp_path / "a.npz"), "--resolution", "4", "--rounds", "1", "--rays", str(tmp_path / "rays.json")]
    assert run(["bench", "access", *arguments, "--format", "json", "-o", str(out), "--plot", str(plot)]) == 0
    reads, rays, _ = read_output("bench", out.read_text())["tables"]
    names = [row["structure"].partition(":")[0] for row in reads["rows"]]
    assert names[: len(READERS)] == [row.name for row in READERS]
    assert "no g++ here" in reads["rows"][6]["structure"]
    assert [row["cameras"] for row in rays["rows"]] == [1, 1]
    assert "dense pointers" in plot.read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (
            ["a.svo.pb", "--resolution", "64"],
            2,
            "a.svo.pb: an octree has its own resolution; allowed: --resolution with",
        ),
        (
            ["a.svo.pb", "--resolution", "64,0"],
            2,
            "'64,0' is not a list of resolutions; allowed: R,R,..., each 1 to 4096",
        ),
        (["a.svo.pb", "--plot", "a.pdf"], 2, "the extension of 'a.pdf' is not that of a chart; allowed: .png, .svg"),
        (["a.svo.pb", "-o", "a.svo.pb"], 4, "a.svo.pb: exists already; allowed: a new file, or --force"),
        (["a.svo.pb", "--rays", "nothing.json"], 1, "nothing.json: No such file"),
        (
            ["a.svo.pb", "--rays", "a.svo.pb"],
            1,
            "as a volume); allowed: cameras",
        ),
        (["nothing.svo.pb"], 1, "nothing.svo.pb: No such file"),
    ],
)
def test_wrong_usage_is_said_before_anything_is_measured(
    arguments: list[str], code: int, said: str, tmp_path: Path, shell: Shell
) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    done = shell("bench", "access", *arguments)
    assert (done.returncode, done.stdout) == (code, b"")
    assert said in done.stderr.decode().splitlines()[-1]
