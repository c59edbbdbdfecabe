"""Atlases from folders to folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from nerfbake import Stage1, load, orbit_cameras, save
from nerfbake.errors import BudgetMissed, InvalidScene, OutputError
from nerfbake.jobs import Budget, FolderTarget, Stage1Source, bake_atlas_folder, measure_atlas
from tests.jobs.listener import Listener
from tests.support.atlas_scenes import stage1_folder

SMALL: Any = {"clusters": 3, "map_size": 8}


def test_facts_are_those_of_the_folder(tmp_path: Path, stage1: Path, listener: Listener) -> None:
    reported: list[dict[str, Any]] = []
    target = tmp_path / "out"
    baked = bake_atlas_folder(str(stage1), target, steps=listener, report=reported.append, **SMALL)
    (facts,) = reported
    assert facts["files"] == {path.name: path.stat().st_size for path in target.iterdir()}
    assert facts["errors"] == json.loads((target / "atlas.json").read_text())["errors"] == baked.facts["errors"]
    assert listener.said[0].startswith(f"{target}: {baked}, MAE {facts['errors'][0]['mae']:.3f}")
    assert [error._asdict() for error in measure_atlas(target, stage1)] == facts["errors"]


def test_a_texture_and_an_mlp_are_enough(tmp_path: Path, stage1: Path) -> None:
    parts = Stage1Source(features=(str(stage1 / "feat1_0.png"),), mlp=str(stage1 / "mlp.json"))
    bake_atlas_folder(parts, tmp_path / "out", **SMALL)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["atlas.json", "atlas_0.png", "labels_0.png"]


def test_figures_are_reported_even_where_the_budget_is_missed(tmp_path: Path, stage1: Path) -> None:
    save(tmp_path / "c.json", orbit_cameras(load(stage1, Stage1), frames=2, width=40, height=40))
    reported: list[dict[str, Any]] = []
    budget = Budget(min_psnr=80, cameras=str(tmp_path / "c.json"))
    with pytest.raises(BudgetMissed):
        bake_atlas_folder(str(stage1), tmp_path / "out", budget=budget, report=reported.append, **SMALL)
    assert len(reported) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.json", "out.rejected"]


def test_a_folder_that_may_not_be_replaced_is_told_before_anything_is_read(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "atlas.json").touch()
    with pytest.raises(OutputError, match="exists already"):
        bake_atlas_folder("none", tmp_path / "out")
    source = stage1_folder(tmp_path / "in", mesh_0_obj=None)
    with pytest.raises(InvalidScene, match=r"mesh_0\.obj is missing"):
        bake_atlas_folder(
            str(source), FolderTarget(str(tmp_path / "out"), force=True), budget=Budget(min_psnr=10), **SMALL
        )
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["atlas.json"]
