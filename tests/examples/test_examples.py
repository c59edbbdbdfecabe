"""The examples, run as they stand: each writes the same octrees as a loop."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from nerfbake import sample_n3tree, save
from nerfbake.jobs import bake_octree
from tests.conftest import REPOSITORY

EXAMPLES = REPOSITORY / "examples"
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, and what becomes of them."""
    folder = tmp_path_factory.mktemp("baked")
    (folder / "scenes").mkdir()
    (folder / "baked").mkdir()
    for name in ("a", "b"):
        save(folder / "scenes" / f"{name}.npz", sample_n3tree(resolution=8, basis="SH1", seed=ord(name)))
        bake_octree(folder / "scenes" / f"{name}.npz", folder / "baked" / f"{name}.svo.pb")
    return folder


@pytest.fixture
def folder(baked: Path, tmp_path: Path) -> Path:
    """Where an example runs: the examples' files beside the scenes."""
    shutil.copytree(baked / "scenes", tmp_path / "scenes")
    shutil.copytree(EXAMPLES, tmp_path, dirs_exist_ok=True)
    return tmp_path


def run(folder: Path, *command: str, **variables: str) -> None:
    environment = os.environ | {"PATH": PATH, "HOME": str(folder)} | variables
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr.decode()


def require_the_same(folder: Path, baked: Path) -> None:
    for path in (baked / "baked").iterdir():
        assert (folder / "baked" / path.name).read_bytes() == path.read_bytes()
    assert len(list((folder / "baked").iterdir())) == 2


@pytest.mark.slow
def test_make(folder: Path, baked: Path) -> None:
    run(folder, "make", "-j2", "-k")
    require_the_same(folder, baked)


@pytest.mark.slow
def test_slurm_by_a_stand_in_that_counts_its_jobs(folder: Path, baked: Path) -> None:
    plan = "nerfbake batch 'svo {in} baked/{stem}.svo.pb' scenes/*.npz --plan > jobs.txt"
    assert f"    {plan}\n" in (EXAMPLES / "README.md").read_text()
    run(folder, "sh", "-c", plan)
    for number in ("1", "0"):
        run(folder, "sh", "slurm.sh", SLURM_ARRAY_TASK_ID=number, SLURM_ARRAY_TASK_COUNT="2")
    run(folder, "nerfbake", "batch", "--state", "run", "--report", "run/report.html")
    require_the_same(folder, baked)


@pytest.mark.long
def test_snakemake(folder: Path, baked: Path) -> None:
    if find_spec("snakemake") is None:
        pytest.skip("Snakemake is not installed: pip install snakemake")
    run(folder, sys.executable, "-m", "snakemake", "-c", "2", "-k", "--quiet", "--config", "shards=2")
    assert sorted(path.name for path in (folder / "run").glob("*.ok")) == ["shard.0-of-2.ok", "shard.1-of-2.ok"]
    run(folder, "nerfbake", "batch", "--state", "run")
    require_the_same(folder, baked)


@pytest.mark.long
def test_dask(folder: Path, baked: Path) -> None:
    if find_spec("distributed") is None:
        pytest.skip("Dask is not installed: pip install 'dask[distributed]'")
    run(folder, sys.executable, "dask_bake.py")
    require_the_same(folder, baked)
