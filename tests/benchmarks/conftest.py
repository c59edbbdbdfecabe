"""Scenes small enough to run every benchmark on, and measuring that starts no process where none is needed."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import scenes as suite_scenes
from benchmarks.scenes import Sample, Scenes
from nerfbake import (
    Cameras,
    build_field,
    orbit_cameras,
    orbit_room,
    render_field,
    render_room,
    sample_n3tree,
    sample_stage1,
    save,
)
from nerfbake.bench.measure import Result, seconds_of
from nerfbake.io import save_folder
from tests.bench.conftest import MODULES, here
from tests.support.captures import Rig, write_colmap_binary, write_llff
from tests.support.forks import Forks
from tests.support.photographs import write_picture, write_scene

EDGE = 16  # voxels an axis, pixels and texels


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the names of the real scenes, and little in it."""
    folder = tmp_path_factory.mktemp("data")
    chairs, cameras = folder / "plenoctree" / "chair", folder / "nerf_synthetic" / "chair"
    for path in (chairs / "views", cameras, folder / "nerf2mesh"):
        path.mkdir(parents=True)
    tree = sample_n3tree(resolution=EDGE, basis="SH4")
    for name in ("chair_sh9", "chair_sh9_128", "chair_sh9_128_quant"):
        save(chairs / f"{name}.npz", tree)
    field = build_field(tree)
    views = orbit_cameras(field, frames=2, width=EDGE, height=EDGE)
    save(chairs / "views" / "transforms.json", views)
    write_scene(cameras, frames=8, edge=EDGE)  # two of them judge
    shutil.copytree(cameras, folder / "nerf_synthetic_800" / "chair")
    for camera in views.cameras:
        save(chairs / "views" / f"{camera.name}.png", render_field(field, camera))
    save_folder(folder / "nerf2mesh" / "mesh_stage1", sample_stage1(resolution=EDGE))
    return folder


@pytest.fixture(scope="session")
def photographed(data: Path) -> Path:
    """Plush, eight photographs of the sample room with a COLMAP model, and mug, the sample scene with masks."""
    folder = data / "captures"
    room = orbit_room(frames=8, width=240, height=180)
    plush = write_colmap_binary(folder / "plush", _rig(room))
    for i, camera in enumerate(room.cameras):
        write_picture(plush / "images" / f"r_{i}.png", render_room(camera, samples=2).pixels)
    field = build_field(sample_n3tree(resolution=EDGE))
    orbit = orbit_cameras(field, frames=8, width=48, height=48)
    mug = write_llff(folder / "mug", _rig(orbit))
    for i, camera in enumerate(orbit.cameras):
        image = render_field(field, camera, background=None)
        write_picture(mug / "images" / f"r_{i}.JPG", image.over((0.5, 0.5, 0.5)).pixels)
        write_picture(mug / "masks" / f"r_{i}.png", (255 * image.alpha).astype(np.uint8))
    return folder


def _rig(cameras: Cameras) -> Rig:
    first = cameras.cameras[0]
    poses = np.array([camera.pose for camera in cameras.cameras])
    return Rig(first.width, first.height, first.fx, first.fy, first.cx, first.cy, poses)


@pytest.fixture
def scenes(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fewer_rays: None) -> Scenes:
    """The suite's scenes, all of them tiny."""
    tiny: dict[str, Sample] = {name: sample._replace(resolution=EDGE) for name, sample in suite_scenes.SAMPLES.items()}
    monkeypatch.setattr(suite_scenes, "SAMPLES", tiny)
    return Scenes(data, tmp_path)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work is measured here instead of in a child: seconds less for each row."""
    for module in MODULES:
        monkeypatch.setattr(f"nerfbake.bench.{module}.measure", here)
    for name in ("fit", "render", "svo", "wires"):
        monkeypatch.setattr(f"benchmarks.{name}.measure", here)


@pytest.fixture
def commands_as_forks(forks: Forks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that are measured start at once, and nobody asks for their memory."""

    def measured(*command: str | Path, keep: bool = False) -> Result:
        python, *module = map(str, command[:3])
        assert (python, module) == (sys.executable, ["-m", "nerfbake"])
        done, seconds = seconds_of(lambda: forks.run(tuple(map(str, command[3:])), tmp_path, b""))
        assert done.returncode == 0, done.stderr
        facts = {"stdout": done.stdout.decode()} if keep else {}
        return Result(seconds, peak=1, facts={**facts, "worked": seconds})

    for module in ("captures", "fit", "inputs", "promises", "view"):
        monkeypatch.setattr(f"benchmarks.{module}.measure_process", measured)
