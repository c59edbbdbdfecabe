"""The suite is whole, and each of its benchmarks runs: on tiny scenes, for one round."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from benchmarks import __main__ as entry
from benchmarks import atlas, captures, fit, inputs, mesh, outputs, papers, promises, svo, view, wires
from benchmarks.aims import CAPTURES, FINER, FIT, INPUTS, MESH, PAPERS, VIEW
from benchmarks.browser import SWIFTSHADER
from benchmarks.processes import measure_process
from benchmarks.scenes import SAMPLES, Scenes
from benchmarks.suite import RESULTS, SUITE, UNPUBLISHED, run
from benchmarks.view import CHOSEN, OCTREE, SURFACE_COLUMNS
from nerfbake import build_octree, sample_n3tree
from nerfbake.bench.access.readers import READERS
from nerfbake.bench.atlas import AtlasMethod
from nerfbake.bench.measure import Result, Statistics
from nerfbake.bench.report import Report, Table
from nerfbake.scene.atlas import METHODS
from tests.benchmarks.conftest import EDGE
from tests.conftest import REPOSITORY
from tests.support.browser import with_a_browser_of_its_own
from tests.support.outputs import read_output

SHORT = ("--epochs", "cells=32,scale=2,epochs=1,density=0.05/cells=32,epochs=1,split=0.3", "--basis", "SH1")
SHARED = {"__init__", "__main__", "aims", "alone", "browser", "processes", "promises", "scenes", "suite"}


def once(*works: Callable[[], Any], rounds: int) -> list[list[Any]]:
    """in_turn() without its round that does not count."""
    assert rounds == 1
    return [[work()] for work in works]


def surfaces(*args: Any, **options: Any) -> Report:
    """A report like that of compare_surfaces(), whose seven pages test_view_surfaces.py draws and times."""
    rows = [[way, *[Statistics.of([2.0])] * (len(SURFACE_COLUMNS) - 1)] for way in (*view.MLPS, *METHODS, "none")]
    return Report("Pages: small", {}, [Table("Frames", SURFACE_COLUMNS, rows)], [])


def tables(files: dict[str, bytes], name: str) -> dict[str, list[list[str]]]:
    """The cells of a Markdown file's tables, by their titles; those of all its reports."""
    found: dict[str, list[list[str]]] = {}
    for part in files[name].decode().split("\n\n**")[1:]:
        title, _, rest = part.partition("**\n\n")
        _, _, *rows = rest.partition("\n\n")[0].splitlines()
        found.setdefault(title, []).extend([cell.strip() for cell in row.strip("|").split(" | ")] for row in rows)
    return found


def small(name: str, scenes: Scenes) -> dict[str, bytes]:
    (benchmark,) = (benchmark for benchmark in SUITE if benchmark.name == name)
    files = run(benchmark, scenes, rounds=1)
    assert tuple(files) == benchmark.files
    for file in files:
        if file.endswith(".md"):
            assert f"made by `python -m benchmarks {name}`" in files[file].decode()
            assert "load average " in files[file].decode()
    return files


def test_every_module_of_the_suite_is_in_its_table() -> None:
    modules = {path.stem for path in (REPOSITORY / "benchmarks").glob("*.py")}
    assert {benchmark.name for benchmark in SUITE} == modules - SHARED
    for benchmark in SUITE:
        module = import_module(f"benchmarks.{benchmark.name}")
        assert callable(module.reports)
        assert hasattr(module, "chart") == any(file.endswith((".svg", ".png")) for file in benchmark.files)


def test_every_published_file_is_made_by_one_benchmark() -> None:
    made = {file for benchmark in SUITE for file in benchmark.files}
    assert made - UNPUBLISHED == {path.name for path in RESULTS.iterdir()} - UNPUBLISHED
    assert "/benchmarks/results/captures_views.png" in (REPOSITORY / ".gitignore").read_text().split()


def test_there_is_one_stopwatch() -> None:
    """Whoever measures otherwise measures something else."""
    found = set()
    for folder in ("benchmarks", "nerfbake/bench"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            names = {ast.unparse(node) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.expr)}
            if names & {"time.perf_counter", "time.time", "time.monotonic", "os.wait4", "timeit.timeit"}:
                found.add(path.relative_to(REPOSITORY).as_posix())
    assert found == {"nerfbake/bench/measure.py", "benchmarks/processes.py"}  # a function, and a command


def test_every_sample_is_measured_by_somebody() -> None:
    text = "".join((REPOSITORY / "benchmarks" / f"{benchmark.name}.py").read_text() for benchmark in SUITE)
    assert [name for name in SAMPLES if f'"{name}"' not in text] == []


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_svo(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(svo, "TREES", (("chair_sh9", EDGE), (svo.SH16, EDGE), ("no_such_chair", EDGE)))
    found = tables(small("svo", scenes), "svo.md")
    assert [row[0] for row in found["Whole processes"]] == ["chair_sh9", "sample_sh16", "no_such_chair: not there"]
    assert [row[0] for row in found["The chair at 256^3"]] == ["svo.pb full", "svo.pb compact"]
    assert [row[0] for row in found["Scaling"]] == list(svo.SCALING)


@pytest.mark.long
@pytest.mark.usefixtures("commands_as_forks")
def test_inputs(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("PLENOXELS", 5), ("VOXELS", 4), ("STEPS", 2), ("EDGE", 12), ("FRAMES", 1)):
        monkeypatch.setattr(inputs, name, value)
    for name, value in (("SMALL", 8), ("SMALL_FRAMES", 1), ("SMALL_EDGE", 12)):
        monkeypatch.setattr(inputs, name, value)
    monkeypatch.setattr(inputs, "in_turn", once)
    found = tables(small("inputs", scenes), "inputs.md")
    (rows,) = (table for title, table in found.items() if title.startswith("`nerfbake svo"))
    assert [row[:2] for row in rows] == [["ckpt.npz", "5^3"], ["fine_last.tar", "4^3"]]
    (finer,) = (table for title, table in found.items() if title.startswith("The chair as 8^3"))
    assert [row[1] for row in finer] == ["8^3", "8^3", "16^3", "24^3"]
    told = [f"{name}: {what}" for name, what in INPUTS] + [f"{times}x, refitted: dB" for times in FINER]
    assert [row[0] for row in found["Aims"]] == told


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.json")), ids=lambda path: path.name)
def test_kept_reports_are_what_their_schema_says(path: Path) -> None:
    assert read_output("bench", path.read_text())["version"] == 1


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_formats(scenes: Scenes) -> None:
    files = small("formats", scenes)
    aims = tables(files, "formats.md")["Aims"]
    assert len(aims) == 2 * 9
    assert {row[1] for row in aims} == {"at most 2", "at most 0.2", "below 1", "at least 20", "at least 50"}
    whole = read_output("bench", files["formats.json"])["reports"]
    assert [report["head"]["scene"].partition(":")[0] for report in whole] == ["sample SH16", "chair_sh9.npz at 128^3"]
    assert files["formats.csv"].startswith(b"table,format,MB")
    assert b"svo.pb bulk" in files["formats.svg"]


@pytest.mark.long
@pytest.mark.tools
@pytest.mark.usefixtures("in_this_process")
def test_wires(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wires, "EDGE", 3)
    (rows,) = tables(small("wires", scenes), "wires.md").values()
    assert [tuple(row[:2]) for row in rows] == [(wire, way) for wire in wires.WIRES for way in ("write", "read")]
    assert {row[-1] for row in rows} == {"yes"}  # exact


@pytest.mark.long
@pytest.mark.tools
@pytest.mark.usefixtures("in_this_process")
def test_vdb(scenes: Scenes) -> None:
    (rows,) = tables(small("vdb", scenes), "vdb.md").values()
    assert [row[5] for row in rows if row[5] != "-"] == ["at most 1", "at most 1"]
    assert {row[-1] for row in rows} == {"yes"}  # the same voxels


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_access(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    some = tuple(reader for reader in READERS if reader.name in ("VDB", "VDB index", "NanoVDB C++"))
    monkeypatch.setattr("nerfbake.bench.access.comparison.READERS", some)
    monkeypatch.setattr("nerfbake.bench.access.readers.which", lambda name: None)
    monkeypatch.setattr("nerfbake.bench.access.rays.RAYS_EDGE", 8)
    monkeypatch.setattr("benchmarks.access.RESOLUTIONS", (8, EDGE))
    monkeypatch.setattr("benchmarks.access.FINE", EDGE)
    files = small("access", scenes)
    found = tables(files, "access.md")
    # Without NanoVDB there is nothing to hold the reads to, and no aim holds.
    assert found["Aims"] == [[f"VDB at {R}^3: surface, x NanoVDB", "at most 0.6", "-", "no"] for R in (8, EDGE)]
    assert {row[1] for row in found["Samples along rays, 8x8"]} == {"2"}
    assert {row[1] for row in tables(files, "access_800.md")["Trilinear reads"]} == {str(EDGE)}


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_render(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.render.EDGES", (8,))
    files = small("render", scenes)
    text = files["render.md"].decode()
    assert [line for line in text.splitlines() if line.startswith("# ")] == [
        "# Rendering: chair_sh9.npz",
        "# Rendering: chair_sh9_128.npz",
    ]
    assert {row[1] for row in tables(files, "render.md")["Aims"]} == {"at most 80", "at most 60", "below 1.5"}
    assert b"N3Tree 8x8" in files["render.svg"]


@pytest.mark.long
@pytest.mark.tools
@pytest.mark.usefixtures("commands_as_forks")
@with_a_browser_of_its_own
def test_view(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "EDGE", 48)
    monkeypatch.setattr(view, "TEXELS", EDGE)
    monkeypatch.setattr(view, "FRAMES", 2)
    monkeypatch.setattr(view, "in_turn", once)
    monkeypatch.setattr(view, "RENDERERS", {"SwiftShader": SWIFTSHADER})
    monkeypatch.setattr(view, "compare_surfaces", surfaces)
    files = small("view", scenes)
    found = tables(files, "view.md")
    assert [row[0] for row in found["Aims"]] == list(VIEW)
    assert [row[0] for row in found["Pages"]] == ["compressed", "exact"]
    assert [row[0] for row in found["Frames"]] == [OCTREE, CHOSEN, *view.MLPS, *METHODS, "none"]
    # Of a tiny scene each of these is far within its aim, on any machine.
    held = {row[0]: row[-1] for row in found["Aims"]}
    assert [held[what] for what in ("compressed: MB", "exact: MB")] == ["yes", "yes"]


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process", "commands_as_forks")
def test_fit(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "RESOLUTION", 32)
    monkeypatch.setattr(fit, "COARSE", 8)
    monkeypatch.setattr(fit, "LIKE", ("--frames", "2", "--edge", "8", "--epochs", "1"))
    monkeypatch.setattr(fit, "FIT", {name: aims for name, aims in FIT.items() if name == "balanced"})
    monkeypatch.setattr("benchmarks.fit.EDGE", 8)
    monkeypatch.setattr("nerfbake.bench.access.rays.RAYS_EDGE", 8)
    files = small("fit", scenes)
    found = tables(files, "fit.md")
    assert [row[0] for row in found["Fits, from the written file"]] == ["balanced", "balanced"]
    (refits,) = (rows for title, rows in found.items() if "refit" in title)
    assert [row[0] for row in refits] == 2 * ["its photographs"] + 2 * ["the PlenOctree"]
    assert len(found["Aims"]) == 2 * 3 + 4
    assert b"balanced" in files["fit.svg"]


@pytest.mark.slow
def test_papers(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(papers, "PAPERS", {"fast": PAPERS["fast"]})
    monkeypatch.setattr("nerfbake.bench.fit.comparison._schedule", lambda preset: SHORT)
    files = small("papers", scenes)
    found = tables(files, "papers.md")
    (fit,) = found["Fits, from the written file"]
    assert fit[:2] == ["chair", "fast"]
    assert [row[0] for row in found["Aims"]] == [f"fast: {what}" for what in ("s", "PSNR dB", "MB", "peak MB")]
    assert [row[-1] for row in found["Aims"]] == ["yes", "no", "yes", "yes"]
    assert b"nerfbake, fast" in files["papers.svg"]
    with pytest.raises(ValueError, match="the same bytes in every round"):
        papers.reports(scenes, rounds=2)


@pytest.mark.long
@pytest.mark.usefixtures("commands_as_forks", "photographed")
def test_captures(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captures, "ROWS", tuple(row._replace(options=SHORT) for row in captures.ROWS[3:]))
    monkeypatch.setattr(captures, "ALONE", captures.ALONE._replace(options=SHORT))
    monkeypatch.setattr(captures, "ROOM_FRAMES", 8)
    monkeypatch.setattr(captures, "ROOM_EDGE", 32)
    files = small("captures", scenes)
    found = tables(files, "captures.md")
    fits = found["Fits, from the written file"]
    assert [row[0] for row in fits] == [*(row.name for row in captures.ROWS), captures.ALONE.name]
    assert all(8 < float(row[5]) <= float(row[4]) < 60 for row in fits)  # the worst and the mean
    assert [row[0] for row in found["From the photographs of plush alone"]] == ["poses", "fit", "view", "together"]
    (poses,) = found["Poses of the photographs of plush"]
    assert poses[:2] == ["8", "8"]
    assert float(poses[-1]) < 1
    assert len(found["Aims"]) == 2 + 2 * len(CAPTURES) + 2 + 1
    assert [row[0] for row in found["Depths of the room"]] == ["0000"]
    assert b"mug 432x432" in files["captures.svg"]
    with Pillow.open(BytesIO(files["captures_views.png"])) as sheet:
        assert sheet.size == (4 * 240 + 3 * 4, 24 + 32 + 180 + 2 * 4)


def test_captures_that_are_missing_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captures, "ROWS", captures.ROWS[:1])
    found = tables(small("captures", Scenes(tmp_path / "nowhere", tmp_path)), "captures.md")
    assert [row[0] for row in found["Fits, from the written file"]] == ["plush 504x378, fast: not there"]
    assert [row[0] for row in found["From the photographs of plush alone"]] == ["poses: not there"]
    assert {row[-1] for row in found["Aims"]} == {"no"}


@pytest.mark.long
def test_mesh(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = tuple(
        row._replace(options=("--triangles", "500", "--texture", "64")) for row in (mesh.AIMED, *mesh.ROWS[-2:])
    )
    monkeypatch.setattr(mesh, "ROWS", (*rows, rows[0]._replace(name="none", out="a.stl")))
    monkeypatch.setattr(mesh, "ATLASES", {"64 clusters": ("--clusters", "2")})
    monkeypatch.setattr(mesh, "LEVELS", (10.0, 40.0))
    files = small("mesh", scenes)
    found = tables(files, "mesh.md")
    meshes = found["Meshes of the chair, from the written file"]
    assert [row[0].partition(":")[0] for row in meshes] == [*(row.name for row in rows), "none", mesh.CONTENDER]
    assert "no file extension for a mesh" in meshes[3][0]
    assert all(5 < float(row[3]) < 60 for row in (*meshes[:3], meshes[4]))
    assert len(found["Aims"]) == len(MESH)
    assert [row[0] for row in found["Atlases of the folder"]] == ["64 clusters"]
    assert b"vertex colours" in files["mesh.svg"]


def test_marching_cubes_of_the_contender_stand_around_the_densities() -> None:
    octree = build_octree(sample_n3tree(resolution=16))
    found = mesh.marched(octree, 10.0)
    points = found.positions[found.faces].mean(axis=1)
    densities = octree.sample(points, lookup="trilinear")[:, -1]
    np.testing.assert_allclose(np.median(densities), 10, rtol=0.5)
    assert found.colours is not None
    assert len(found.colours) == len(found.positions)


@pytest.mark.long
def test_outputs(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    some = [output for output in outputs.OUTPUTS if output[0] in ("half.svo.npz", "half.svo.npz.zst")]
    monkeypatch.setattr(outputs, "OUTPUTS", some)
    rows = tables(small("outputs", scenes), "outputs.md")["Outputs"]
    assert [row[2] for row in rows] == ["100.00", "100.00"]
    with pytest.raises(ValueError, match="the same in every round"):
        outputs.reports(scenes, rounds=2)


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_atlas(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = []

    def compiled_already(*command: str | Path, environment: dict[str, str]) -> Result:
        folders.append(environment["NUMBA_CACHE_DIR"])
        return measure_process(*command)

    monkeypatch.setattr("nerfbake.bench.atlas.VARIANTS", [AtlasMethod("kmeans", 4), AtlasMethod("grid", 2)])
    monkeypatch.setattr("nerfbake.bench.atlas.CLUSTERINGS", [("nerfbake", 4), ("KMeans", 4)])
    monkeypatch.setattr(atlas, "WARM", (4,))
    monkeypatch.setattr(atlas, "COLD", 4)
    monkeypatch.setattr(atlas, "measure_process", compiled_already)
    files = small("atlas", scenes)
    found = tables(files, "atlas.md")
    assert [row[0] for row in found["Atlases"]] == ["kmeans K=4", "grid 2^3"]
    assert [row[0] for row in found["Clusterings"]] == ["nerfbake", "KMeans"]
    (whole,) = (rows for title, rows in found.items() if "as a whole" in title)
    assert [row[0] for row in whole] == ["4, cold", "4, warm"]
    assert files["atlas.png"].startswith(b"\x89PNG")
    warm, counted, cold = folders
    assert warm == counted != cold  # which is new, and has no compiled kernels


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process", "commands_as_forks", "photographed")
def test_compress(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.bench.compress.LOSSES", (0.1,))
    for name, value in (("GOALS", (0.3,)), ("FRAMES", 8), ("EDGE", 16), ("FIT", SHORT)):
        monkeypatch.setattr(promises, name, value)
    files = small("compress", scenes)
    rows = tables(files, "compress_promises.md")["Promised and measured"]
    assert rows[-1][0] == "biker, splats as 256^3: not there"
    own, usual = [row for row in rows if row[0] == "chair, 128^3"]
    assert [own[2] == own[1][:-1], usual[2], own[3]] == [True, "-", "0.30"]
    assert all(float(row[5]) < float(row[6]) <= 0.3 for row in rows[:-1])  # expected, promised
    left = tables(files, "compress_promises.md")["Left out"]
    assert [row[0] for row in left] == list(dict.fromkeys(row[0] for row in rows[:-1]))
    found = tables(files, "compress.md")
    assert [row[0] for row in found["Compression"]][:2] == ["svoq range, 0.1 dB", "svoq deflate, 0.1 dB"]
    assert len(found["Aims"]) == 6
    assert b"palette of 256" in files["compress.svg"]


def test_the_entry_writes_what_is_asked_for_and_nothing_where_something_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def made(benchmark: Any, scenes: Scenes) -> dict[str, bytes]:
        assert scenes.folder.is_dir()
        return {file: benchmark.name.encode() for file in benchmark.files}

    monkeypatch.setattr(entry, "RESULTS", tmp_path)
    monkeypatch.setattr(entry, "DATA", tmp_path / "nowhere")
    assert entry.main(["outputs", "render"]) == 1
    assert "error: render: " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(entry, "run", made)
    assert entry.main(["vdb", "atlas"]) == 0
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "vdb.md": b"vdb",
        "atlas.md": b"atlas",
        "atlas.png": b"atlas",
    }
    assert entry.main([]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {file for benchmark in SUITE for file in benchmark.files}


def test_a_name_that_no_benchmark_has_is_refused() -> None:
    command = [sys.executable, "-m", "benchmarks", "svo", "speed"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    allowed = "svo, formats, wires, vdb, access, render, outputs, batch, fit, cores, papers, captures, mesh, inputs, "
    allowed += "splats, atlas, view, compress, gpu"
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: no benchmark is called 'speed'; allowed: {allowed}\n"
