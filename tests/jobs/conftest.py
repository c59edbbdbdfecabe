"""Small scenes in a folder of their own, where each test of a job works."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import build_field, build_octree, orbit_cameras, save
from nerfbake.jobs import write_sample_stage1
from tests.jobs.listener import Listener
from tests.support.scenes import n3tree


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """a.npz, the same at its own resolution as a.svo.pb, and three cameras around it."""
    monkeypatch.chdir(tmp_path)
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    save("a.npz", tree)
    save("a.svo.pb", build_octree(tree))
    save("cameras.json", orbit_cameras(build_field(tree), frames=3, width=20, height=16))
    return tmp_path


@pytest.fixture(scope="session")
def stage1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stage-1 folder with a mesh."""
    path = tmp_path_factory.mktemp("stage1") / "in"
    write_sample_stage1(path, resolution=64)
    return path


@pytest.fixture
def listener() -> Listener:
    return Listener()
