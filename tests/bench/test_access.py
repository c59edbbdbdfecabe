from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import build_octree, build_vdb, sample_n3tree, save
from nerfbake.bench import _readers, access
from nerfbake.bench._points import kinds_of_points
from nerfbake.bench._rays import Counts, count_samples
from nerfbake.bench.measure import Result, Spread
from nerfbake.bench.report import markdown
from nerfbake.cli.main import run
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import VdbTree
from tests.conftest import Shell
from tests.formats.octree.octrees import small_octree
from tests.support.scenes import n3tree
from tests.support.vdb_readers import tree, volume

OURS = ("dense array", "dense pointers", "octree", "VDB", "VDB index")
NANOVDB = ("NanoVDB C++", "NanoVDB C++, no stencil cache")
POINTS = 3000


def quiet(_: str) -> Any:
    return nullcontext()


@pytest.fixture(scope="module")
def octree() -> SparseVoxelOctree:
    """Leaves of several sizes, and edges that are no power of two."""
    return build_octree(sample_n3tree(resolution=32, basis="SH4", seed=3), resolution=(32, 20, 27))


@pytest.fixture(scope="module")
def folder(octree: SparseVoxelOctree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("access")
    density, index = (build_vdb(octree, grids=(grid,)) for grid in ("density", "index"))
    access._write(home, octree, density, index, POINTS)
    return home


@pytest.mark.parametrize("channels", [1, 13])
@pytest.mark.parametrize("name", OURS)
def test_every_structure_reads_what_the_grid_reads(
    name: str, channels: int, folder: Path, octree: SparseVoxelOctree
) -> None:
    grid = build_vdb(octree, grids=("index",)).grids[0]
    for kind in access.KINDS:
        points = np.fromfile(folder / f"{kind}.f32", np.float32).reshape(-1, 3).astype(np.float64)
        structure = _readers._structure(name, folder, channels, 1 << 30)
        out = np.empty((len(points), channels), np.float32)
        structure.read(*structure.arrays, points, out)
        assert_allclose(out, grid.sample(points, lookup="trilinear")[:, -channels:], rtol=1e-5, atol=1e-3)
        assert np.count_nonzero(out) > len(points) / 50


@pytest.mark.slow
def test_warp_reads_the_same(folder: Path) -> None:
    assert _sums("Warp", folder) == pytest.approx(_sums("VDB", folder), rel=1e-5)


@pytest.mark.tools
@pytest.mark.slow
def test_nanovdb_reads_the_same(folder: Path) -> None:
    if (missing := folder / "nanovdb.missing").exists() and "(Debian: " in missing.read_text():
        pytest.skip(f"{missing.read_text()}: `make tools` installs it")
    for name in NANOVDB:
        assert _sums(name, folder) == pytest.approx(_sums("VDB", folder), rel=1e-5)


def _sums(name: str, folder: Path) -> list[float]:
    work = _readers.reading(name, str(folder), 1, list(access.KINDS), 1 << 30)
    return [found[1] for found in work.check(work.run())["found"]]


def test_points_are_where_their_kind_says(octree: SparseVoxelOctree) -> None:
    topology = build_vdb(octree, grids=("density",)).grids[0].topology
    assert topology.box is not None
    kinds = kinds_of_points(octree.size, topology, POINTS)
    assert tuple(kinds) == access.KINDS
    assert all(len(points) in (POINTS, POINTS // 800 * 800) and points.dtype == np.float32 for points in kinds.values())
    active = {tuple(voxel) for voxel in topology.coords.tolist()}
    assert all(tuple(voxel) in active for voxel in np.floor(kinds["surface"] + 0.4999).astype(int).tolist())
    assert (kinds["rays"] >= topology.box[0] - 0.51).all()
    assert (kinds["rays"] <= topology.box[1] + 0.51).all()
    steps = np.linalg.norm(np.diff(kinds["rays"], axis=0), axis=1)
    assert np.median(steps) == pytest.approx(0.5, rel=1e-4)
    again = kinds_of_points(octree.size, topology, POINTS)
    assert all((again[kind] == kinds[kind]).all() for kind in kinds)


def test_what_does_not_fit_is_a_row_that_says_so(folder: Path) -> None:
    with pytest.raises(MemoryLimit, match=r"it needs 877.5 KiB; allowed: 500.0 KiB \(--max-memory\)"):
        _readers._structure("dense array", folder, 13, 500 << 10)
    tree = sample_n3tree(resolution=32)
    tree.require_sound()  # which takes memory of its own, once
    with memory_limit(1 << 12):
        report = access.compare(tree, "s", resolutions=[32], rounds=1, progress=quiet)
    ((said, R, *others),) = report.tables[0].rows
    assert said.startswith("all: ")
    assert "--max-memory" in said
    assert (R, set(others)) == (32, {None})


def test_without_a_compiler_nanovdb_keeps_its_rows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(_readers, "which", lambda name: None)
    _readers.compile_nanovdb(tmp_path)
    with pytest.raises(NerfbakeError, match=r"no g\+\+ here \(Debian: g\+\+\)") as said:
        _readers.reading(NANOVDB[0], str(tmp_path), 1, [], 0)
    row = _readers.Contender(NANOVDB[0], all=False)
    rows = access._figures(64, {(row, 1): [Result(error=str(said.value))]})
    assert rows == [[f"{NANOVDB[0]}: {said.value}", 64, 1, *[None] * 7]]


@pytest.mark.tools
def test_without_headers_or_with_wrong_ones_nanovdb_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for code, said in (
        ("#include <nanovdb/util/IO.h: No such file>\n", "no headers of NanoVDB here (Debian: libnanovdb-dev)"),
        ("int main() { return nanovdb; }\n", "g++ "),
    ):
        source = tmp_path / "a.cpp"
        source.write_text(code)
        monkeypatch.setattr(_readers, "SOURCE", source)
        _readers.compile_nanovdb(tmp_path)
        text = (tmp_path / "nanovdb.missing").read_text()
        assert text.startswith(said)
    assert "error" in text


def test_openvdb_keeps_its_row() -> None:
    with pytest.raises(NerfbakeError, match=r"2.5 microseconds each"):
        _readers.reading("OpenVDB C++", "", 1, [], 0)


def test_a_wrong_sum_would_be_seen_and_ratios_are_to_the_faster_nanovdb() -> None:
    rows = {contender.name: contender for contender in _readers.CONTENDERS}

    def found(ns: float, total: float) -> list[Result]:
        return [Result(facts={"found": [[ns, total, 100.0]] * 4, "bytes": 1_000_000, "version": ""})]

    cells = access._figures(
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
    assert cells[0][3:7] == [Spread(10, 10, 10, 1)] * 4


def test_samples_along_a_ray_by_hand() -> None:
    # A ray down the x axis through eight voxels of a leaf, of edge 0.25, seen through a single pixel.
    coords = np.array([[x, 0, 0] for x in (0, 1, 2, 3, 6, 7)])
    grid = tree(coords)
    values = np.full((6, 1), 2.0, np.float32)
    values[4] = 0
    grid = VdbTree("density", grid.topology, values, grid.background)
    scene = volume(grid)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]], axis=1)
    pose[:3, 3] = scene.transform[:, 3] + scene.transform[:, :3] @ [20.2, 0, 0]
    camera = Camera(1, 1, 1.0, pose)
    assert count_samples(scene, grid, camera) == Counts(possible=16, valid=12, needed=10)
    opaque = VdbTree("density", grid.topology, np.full((6, 1), 1e3, np.float32), grid.background)
    assert count_samples(scene, opaque, camera) == Counts(16, 12, 1)
    far = pose.copy()
    far[0, 3] = 1e15  # which is four times as many voxels
    with pytest.raises(InvalidScene, match="a camera is too far away; allowed: rays that can be told in voxels"):
        count_samples(scene, grid, Camera(1, 1, 1.0, far))
    empty = tree(np.zeros((0, 3)))
    assert count_samples(volume(empty), empty, camera) == Counts(0, 0, 0)


@pytest.mark.slow
def test_the_report_and_its_chart(octree: SparseVoxelOctree, monkeypatch: pytest.MonkeyPatch) -> None:
    some = tuple(row for row in _readers.CONTENDERS if row.name in ("VDB", "VDB index", "OpenVDB C++"))
    monkeypatch.setattr(access, "CONTENDERS", some)
    camera = Camera(40, 40, 40.0, np.eye(4), "a")
    report = access.compare(octree, "s", resolutions=None, rounds=2, progress=quiet, cameras=[camera], points=POINTS)
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
    assert b"VDB index" in access.chart(report, ".svg")


def test_a_density_that_float16_cannot_hold_costs_its_rows_only(tmp_path: Path) -> None:
    tree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    tree.sigma[-1] = 1e6
    density, index = (build_vdb(tree, grids=(grid,)) for grid in ("density", "index"))
    rows = access._file_rows(tmp_path, 4, tree, density, index)
    refused = [what for what, _, size in rows if size is None]
    assert refused == [
        f"{what} half: grid {what!r} holds 1e+06; allowed: up to 65504 for --half" for what in ("density", "index")
    ]
    assert [what for what, _, size in rows if size] == [
        "octree .svo.npz", "octree .svo.pb", "density .nvdb", "density .nvdb zip", "density .vdb", "density .vdb zip",
        "index .nvdb", "index .nvdb zip",
    ]  # fmt: skip


def test_a_format_that_is_too_small_costs_its_row_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.formats.octree.protobuf.MAX_2GIB", 100)
    tree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    density, index = (build_vdb(tree, grids=(grid,)) for grid in ("density", "index"))
    (refused,) = (what for what, _, size in access._file_rows(tmp_path, 4, tree, density, index) if size is None)
    assert refused.startswith("octree .svo.pb: svo.pb would take ")
    assert refused.endswith("allowed: 100, protobuf's limit")


def test_a_scene_without_a_voxel_is_refused() -> None:
    empty = build_octree(n3tree(splits=[], data_format="SH4"), sigma_min=1e9)
    with pytest.raises(InvalidScene, match="the scene has no voxel; allowed: a density above 0"):
        access.compare(empty, "s", resolutions=None, rounds=1, progress=quiet)


@pytest.mark.slow
def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(access, "kinds_of_points", lambda size, topology, _: kinds_of_points(size, topology, POINTS))
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))]))
    save(tmp_path / "rays.json", Cameras((Camera(8, 8, 8.0, np.eye(4), "a"),)))
    out, plot = tmp_path / "out.json", tmp_path / "out.svg"
    arguments = [str(tmp_path / "a.npz"), "--resolution", "4", "--rounds", "1", "--rays", str(tmp_path / "rays.json")]
    assert run(["bench", "access", *arguments, "--format", "json", "-o", str(out), "--plot", str(plot)]) == 0
    reads, rays, _ = json.loads(out.read_text())["tables"]
    names = [row["structure"].partition(":")[0] for row in reads["rows"]]
    assert names[: len(_readers.CONTENDERS)] == [row.name for row in _readers.CONTENDERS]
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
        (["a.svo.pb", "--resolution", "64,0"], 2, "'64,0' are no resolutions; allowed: R,R,..., each 1 to 4096"),
        (["a.svo.pb", "--plot", "a.pdf"], 2, "the ending of 'a.pdf' names no picture; allowed: .png, .svg"),
        (["a.svo.pb", "-o", "a.svo.pb"], 4, "a.svo.pb: exists already; allowed: a new file, or --force"),
        (["a.svo.pb", "--rays", "nothing.json"], 1, "nothing.json: No such file"),
        (
            ["a.svo.pb", "--rays", "a.svo.pb"],
            1,
            "writes it in other formats); allowed: cameras",
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
