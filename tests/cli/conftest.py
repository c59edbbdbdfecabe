"""Scenes that the tests of several commands start from."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import save
from nerfbake.cli.main import run
from tests.support.scenes import n3tree


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    return tmp_path / "a.npz"


@pytest.fixture(scope="package")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stage-1 folder, `in`, and an atlas of it, `out`."""
    folder = tmp_path_factory.mktemp("sample")
    assert run(["sample", "nerf2mesh", str(folder / "in"), "--resolution", "64", "-q"]) == 0
    assert run(["atlas", str(folder / "in"), str(folder / "out"), "--clusters", "8", "-q"]) == 0
    return folder
