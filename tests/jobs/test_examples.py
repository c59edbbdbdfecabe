"""The example in each job's docstring, run as it stands."""

from __future__ import annotations

import doctest
import inspect
from pathlib import Path

import numpy as np
import pytest

import nerfbake
from nerfbake import jobs
from tests.support.rooms import write_room
from tests.support.source import public_names
from tests.support.videos import write_video


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where examples find a PlenOctree, an octree, a stage-1 folder and its atlas."""
    folder = tmp_path_factory.mktemp("examples")
    jobs.write_sample_n3tree(folder / "a.npz", resolution=16, basis="SH1")
    jobs.bake_octree(folder / "a.npz", folder / "octree.svo.npz")
    jobs.write_sample_stage1(folder / "mesh_stage1", resolution=32)
    jobs.write_sample_capture(folder / "photographs", frames=16, edge=32)
    write_room(folder / "room")
    write_video(folder / "walk.mp4", list(np.random.default_rng(0).random((60, 16, 16, 3))))
    return folder


LAST = ("bake_lod", "measure_atlas", "view_splats")  # their examples read what another example wrote
NAMES = public_names("nerfbake.jobs")
JOBS = [name for name in NAMES if inspect.isfunction(getattr(jobs, name))]
ORDER = [*(name for name in JOBS if name not in LAST), *LAST]


@pytest.mark.usefixtures("fewer_rays")
@pytest.mark.parametrize("name", ORDER)
def test_an_example_runs(name: str, workshop: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workshop)
    known = {"nerfbake": nerfbake} | {known: getattr(jobs, known) for known in NAMES}
    (example,) = doctest.DocTestFinder().find(getattr(jobs, name), name, globs=known)
    assert example.examples, f"{name}'s docstring has no example"
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert said == []
