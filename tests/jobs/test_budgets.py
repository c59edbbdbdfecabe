"""Budgets: what was written, looked at beside what it was made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Cameras, N3Tree, build_octree, build_vdb, cut_octree, load, save
from nerfbake.errors import BudgetMissed, InvalidFile, InvalidScene
from nerfbake.jobs import Budget, compress_file, judge_output, view_file
from nerfbake.scene.function_field import FunctionField
from nerfbake.stages.scenes_to_comparison import compare_scenes
from tests.jobs.listener import Listener
from tests.support.functions import soft_file
from tests.support.scenes import n3tree

SMALL = {
    "jobs.budgets.EDGE": 8,
    "jobs.function_voxels.RESOLUTION": 16,
    "jobs.function_voxels._EDGE": 4,
    "scene.function_field._COARSE_GRID": 16,
    "stages.function_to_part._RESOLUTION": 16,
    "stages.function_to_image.STEPS": 32,
}


def test_the_file_is_judged_not_what_it_was_made_from(folder: Path, listener: Listener) -> None:
    tree = load("a.npz", N3Tree)
    decibels = judge_output(
        "a.svo.pb", tree, Budget(min_psnr=50, cameras="cameras.json"), made_from="a.npz", steps=listener
    )
    assert decibels is not None
    assert listener.said == [f"a.svo.pb: {decibels:.2f} dB against a.npz"]
    (folder / "a.svo.pb").write_bytes(b"broken on its way to the disk")
    with pytest.raises(InvalidFile, match=r"a\.svo\.pb"):
        judge_output("a.svo.pb", tree, Budget(min_psnr=50, cameras="cameras.json"), made_from="a.npz")


@pytest.mark.usefixtures("folder")
def test_a_budget_is_judged_with_the_rays_that_it_asks_for(listener: Listener) -> None:
    save("small.svo.pb", cut_octree(build_octree(load("a.npz", N3Tree)), level=1))
    save("four.json", replace(load("cameras.json", Cameras), samples=2))
    tree, found = load("a.npz", N3Tree), {}
    for cameras, samples in (("cameras.json", None), ("cameras.json", 2), ("four.json", None), ("four.json", 1)):
        budget = Budget(min_psnr=1, cameras=cameras, samples=samples)
        found[cameras, samples] = judge_output("small.svo.pb", tree, budget, made_from="a.npz", steps=listener)
    assert found["cameras.json", None] == found["four.json", 1] != found["cameras.json", 2] == found["four.json", None]
    assert [line.endswith(", 2x2 rays a pixel") for line in listener.said] == [False, True, True, False]


@pytest.mark.usefixtures("folder")
def test_a_scene_that_cannot_be_seen_is_blamed_by_its_name() -> None:
    lobes = n3tree(data_format="SG2", extra_data=np.ones((2, 4), np.float32))
    with pytest.raises(InvalidScene, match=r"^lobes\.npz: data_format is SG2"):
        judge_output("a.svo.pb", lobes, Budget(min_psnr=50), made_from="lobes.npz")


@pytest.mark.usefixtures("folder")
def test_without_a_limit_nothing_is_read() -> None:
    assert judge_output("none", None, Budget(), made_from="none") is None


@pytest.mark.usefixtures("folder")
def test_a_missed_budget_is_told_with_the_name_that_the_file_will_have() -> None:
    tree = load("a.npz", N3Tree)
    with pytest.raises(BudgetMissed, match=r"^b\.svo\.pb: the picture has a mean PSNR of"):
        judge_output("a.svo.pb", tree, Budget(min_psnr=200, cameras="cameras.json"), made_from="a.npz", name="b.svo.pb")
    Path("a.svo.pb").write_bytes(b"broken")
    with pytest.raises(InvalidFile, match=r"^b\.svo\.pb: "):
        judge_output("a.svo.pb", tree, Budget(min_psnr=1), made_from="a.npz", name="b.svo.pb")


@pytest.mark.usefixtures("folder")
def test_a_volume_whose_y_is_up_is_turned_back() -> None:
    tree = load("a.npz", N3Tree)
    save("y.nvdb", build_vdb(build_octree(tree), grids=("index",), up="y"))
    decibels = judge_output("y.nvdb", tree, Budget(min_psnr=50, cameras="cameras.json"), made_from="a.npz", up="y")
    assert decibels is not None
    with pytest.raises(BudgetMissed):
        judge_output("y.nvdb", tree, Budget(min_psnr=50, cameras="cameras.json"), made_from="a.npz")


@pytest.mark.slow
@pytest.mark.parametrize(("command", "out"), [(compress_file, "f.svoq"), (view_file, "f.html")])
@pytest.mark.usefixtures("folder", "fewer_rays")
def test_a_trained_field_is_the_judge_of_what_is_made_of_it_and_the_device_is_opened_once(
    command: Any, out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judges: list[type] = []
    opened: list[str] = []

    def compare(a: Any, *others: Any, **options: Any) -> Any:
        judges.append(type(a))
        return compare_scenes(a, *others, **options)

    def count(device: str) -> None:
        opened.append(device)

    for name, value in SMALL.items():
        monkeypatch.setattr(f"nerfbake.{name}", value)
    monkeypatch.setattr("nerfbake.stages.scenes_to_comparison.compare_scenes", compare)
    monkeypatch.setattr("nerfbake.jobs.devices.open_device", count)
    Path("field.tar").write_bytes(soft_file())
    limit = {"budget": Budget(min_psnr=1)} if command is compress_file else {"min_psnr": 1}
    command("field.tar", out, **limit)
    assert (judges, opened) == ([FunctionField], ["auto"])
