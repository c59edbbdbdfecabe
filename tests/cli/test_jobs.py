"""Every command does what its job does: the same bytes, the same facts."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from nerfbake import build_field, build_octree, jobs, orbit_cameras, save
from nerfbake.cli import main
from nerfbake.jobs import ComparedViews, ComparisonLimits, ComparisonOutputs, PictureOutputs, ViewSelection
from tests.support.rooms import write_room
from tests.support.scenes import n3tree
from tests.support.videos import write_video

# atlas.json tells the options that were given; the command gives them all.
ATLAS_DEFAULTS: Any = {
    "method": "kmeans", "nodes": 7, "directions": 100, "direction_set": "fibonacci", "centres": "snapped",
    "border": 1, "seed": 0,
}  # fmt: skip
TIMES = re.compile(rb'<data value="[^"]*">[^<]*</data> s</td>')  # of report.html
MESH = ("--frames", "8", "--edge", "32", "--texture", "64")
JOBS: dict[str, tuple[list[str], Callable[[str], object]]] = {
    "fit": (
        ["photographs", "OUT.svo.pb", "--preset", "fast", "--resolution", "32", "--basis", "SH1", "--holdout", "5"],
        lambda out: jobs.fit_file(
            "photographs",
            f"{out}.svo.pb",
            options=jobs.FitOptions(preset="fast", resolution=32, basis="SH1"),
            photographs=jobs.PhotographOptions(holdout=5),
        ),
    ),
    "svo": (
        ["a.npz", "OUT.svo.pb", "--resolution", "3", "--profile", "bulk"],
        lambda out: jobs.bake_octree("a.npz", jobs.Target(f"{out}.svo.pb", profile="bulk"), resolution=(3, 3, 3)),
    ),
    "lattice": (
        ["a.svo.pb", "OUT", "--rounds", "2", "--merged", "--seed", "3"],
        lambda out: jobs.bake_lattice("a.svo.pb", out, rounds=2, merged=True, seed=3),
    ),
    "lod": (
        ["a.svo.pb", "OUT.svo.fb", "--level", "1"],
        lambda out: jobs.bake_lod("a.svo.pb", f"{out}.svo.fb", level=1),
    ),
    "splats": (
        ["a.npz", "OUT.ply", "--count", "200", "--epochs", "1", "--frames", "6", "--edge", "32"],
        lambda out: jobs.bake_splats(
            "a.npz", f"{out}.ply", jobs.SplatsViews(frames=6, edge=32), options=jobs.SplatsOptions(splats=200, epochs=1)
        ),
    ),
    "hull": (
        ["a.npz", "OUT.glb", "--level", "2", "--in-up", "z"],
        lambda out: jobs.bake_hull("a.npz", f"{out}.glb", level=2, in_up="z"),
    ),
    "atlas": (
        ["in", "OUT", "--clusters", "3", "--map-size", "8"],
        lambda out: jobs.bake_atlas_folder("in", out, **{**ATLAS_DEFAULTS, "clusters": 3, "map_size": 8}),
    ),
    "render": (
        ["a.npz", "--out", "OUT", "--cameras", "c.json", "--all", "--depth", "npy", "--lookup", "trilinear"],
        lambda out: jobs.render_views(
            "a.npz",
            PictureOutputs(out=out, depth="npy"),
            ViewSelection(cameras="c.json", every=True),
            lookup="trilinear",
        ),
    ),
    "vdb": (
        ["a.npz", "OUT.vdb", "--grids", "density,sh", "--half", "--codec", "none", "--up", "y"],
        lambda out: jobs.bake_volume("a.npz", f"{out}.vdb", grids="density,sh", half=True, codec="none", up="y"),
    ),
    "compress": (
        ["a.npz", "OUT.svoq", "--step", "0.1", "--coding", "deflate"],
        lambda out: jobs.compress_file("a.npz", f"{out}.svoq", goal=jobs.CompressionGoal(step=0.1), coding="deflate"),
    ),
    "convert": (
        ["a.svo.pb", "OUT.svo.capnp", "--layout", "compact", "--no-child=-1", "--voxel-type", "struct"],
        lambda out: jobs.convert_file(
            "a.svo.pb", jobs.Target(f"{out}.svo.capnp", voxel_type="struct"), layout="compact", no_child=-1
        ),
    ),
    "compare": (
        ["a.npz", "a.svo.pb", "--size", "9x9", "--html", "OUT.html", "--min-psnr", "20"],
        lambda out: jobs.compare_files(
            "a.npz",
            "a.svo.pb",
            seen=ComparedViews(size=(9, 9)),
            limits=ComparisonLimits(min_psnr=20.0),
            pages=ComparisonOutputs(html=f"{out}.html"),
        ),
    ),
    "view": (
        ["a.npz", "OUT.html", "--data", "exact", "--title", "A scene", "--background", "white", "--cameras", "c.json"],
        lambda out: jobs.view_file(
            "a.npz", f"{out}.html", data="exact", title="A scene", background=(1.0, 1.0, 1.0), cameras="c.json"
        ),
    ),
    "ship": (
        ["a.npz", "OUT", "--for", "unity", "--cameras", "c.json"],
        lambda out: jobs.ship_file("a.npz", out, targets=("unity",), cameras="c.json"),
    ),
    "frames": (["a.mkv", "OUT", "--count", "3"], lambda out: jobs.take_frames("a.mkv", out, count=3)),
    "poses": (["OUT", "--seed", "3"], lambda out: jobs.find_poses(out, seed=3)),
    "mesh": (
        ["a.npz", "OUT.glb", *MESH, "--lods", "500,100", "--in-up", "z", "--lit", "--image", "png"],
        lambda out: jobs.bake_mesh(
            "a.npz",
            f"{out}.glb",
            pictures=jobs.MeshViews(frames=8, edge=32),
            options=jobs.MeshOptions(triangles=(500, 100), texture=64),
            file=jobs.MeshFile(in_up="z", lit=True, image="png"),
        ),
    ),
    "refit": (
        ["a.svo.pb", "OUT.svo.pb", "--like", "a.npz", "--frames", "4", "--edge", "24"],
        lambda out: jobs.refit_file("a.svo.pb", f"{out}.svo.pb", jobs.RefitReference(like="a.npz", frames=4, edge=24)),
    ),
    "batch": (
        ["svo {in} OUT.svo.pb", "a.npz", "--state", "state"],
        lambda out: jobs.run_batch(
            [jobs.Item(("svo", "a.npz", f"{out}.svo.pb"), ("a.npz",), (f"{out}.svo.pb",))], state="state"
        ),
    ),
    "shaders": (
        ["OUT", "--language", "wgsl", "--what", "octree", "--what", "world"],
        lambda out: jobs.write_shaders(out, languages=("wgsl",), what=("octree", "world")),
    ),
    "sample octree": (
        ["OUT.npz", "--resolution", "8"],
        lambda out: jobs.write_sample_n3tree(f"{out}.npz", resolution=8),
    ),
    "sample capture": (
        ["OUT", "--frames", "2", "--edge", "32", "--room"],
        lambda out: jobs.write_sample_capture(out, frames=2, edge=32, room=True),
    ),
    "sample nerf2mesh": (
        ["OUT", "--resolution", "32"],
        lambda out: jobs.write_sample_stage1(out, resolution=32),
    ),
}
FACTS: dict[str, tuple[list[str], Callable[[], Any]]] = {
    "info": (["a.svo.pb"], lambda: jobs.describe_file("a.svo.pb")),
    "atlas-error": (
        ["baked", "in", "--directions", "9"],
        lambda: {"errors": [error._asdict() for error in jobs.measure_atlas("baked", "in", directions=9)]},
    ),
}
# Those whose work is a stage's, io's or the benchmarks' own, a call between the words.
NO_JOB = {
    "check",
    "bench formats",
    "bench atlas",
    "bench access",
    "bench compress",
    "bench fit",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("jobs")
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    save(folder / "a.npz", tree)
    save(folder / "a.svo.pb", build_octree(tree))
    save(folder / "c.json", orbit_cameras(build_field(tree), frames=2, width=9, height=9))
    jobs.write_sample_stage1(folder / "in", resolution=32)
    jobs.write_sample_capture(folder / "photographs", frames=10, edge=32)
    jobs.bake_atlas_folder(str(folder / "in"), folder / "baked", clusters=3, map_size=8)
    write_video(folder / "a.mkv", list(np.random.default_rng(0).random((5, 16, 16, 3))))
    write_room(folder / "poses-command")
    shutil.copytree(folder / "poses-command", folder / "poses-job")
    return folder


def written(folder: Path, stem: str) -> dict[str, Any]:
    """What all files hold whose names start so; of JSON what it says, in whatever order. Reports lose their times."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    names = {str(path.relative_to(folder)): path for path in paths}
    return {name.removeprefix(stem): _held(path) for name, path in names.items() if name.startswith(stem)}


def _held(path: Path) -> Any:
    if path.suffix == ".json":
        return json.loads(path.read_text(), object_hook=_without_times)
    return TIMES.sub(b"", path.read_bytes()) if path.name == "report.html" else path.read_bytes()


def _without_times(entries: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entries.items() if key not in ("seconds", "cpu_seconds")}


@pytest.mark.usefixtures("fewer_rays")
@pytest.mark.parametrize("command", JOBS)
def test_a_command_writes_what_its_job_writes(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    arguments, job = JOBS[command]
    stem = command.replace(" ", "-")
    line = [*command.split(), *(word.replace("OUT", f"{stem}-command") for word in arguments), "-q"]
    assert main.run(line) == 0
    job(f"{stem}-job")
    by_command, by_job = written(folder, f"{stem}-command"), written(folder, f"{stem}-job")
    assert by_command
    assert by_command == by_job


@pytest.mark.parametrize("command", FACTS)
def test_a_command_prints_what_its_job_finds(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    arguments, job = FACTS[command]
    assert main.run([command, *arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"version": 1, **json.loads(json.dumps(job()))}


def commands(group: click.Group, prefix: str = "") -> dict[str, click.Command]:
    found: dict[str, click.Command] = {}
    for name, command in group.commands.items():
        found |= commands(command, f"{name} ") if isinstance(command, click.Group) else {f"{prefix}{name}": command}
    return found


def test_every_command_is_in_these_tables_and_keeps_to_one_allowance() -> None:
    known = commands(main.cli)
    assert set(known) == set(JOBS) | set(FACTS) | NO_JOB
    for command in known.values():
        assert "--max-memory" in [option for parameter in command.params for option in parameter.opts]
