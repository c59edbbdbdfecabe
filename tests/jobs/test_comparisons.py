"""Two files seen by the same cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Cameras, Image, Splats, build_octree, load, orbit_cameras, save
from nerfbake.errors import BudgetMissed, InvalidScene, MemoryLimit, OutputError, UsageError
from nerfbake.jobs import (
    ComparedViews,
    ComparisonLimits,
    ComparisonOutputs,
    FileComparison,
    ViewSelection,
    compare_files,
    render_views,
    view_file,
)
from nerfbake.jobs.budgets import Budget, judge_output
from nerfbake.memory import memory_limit
from nerfbake.scene.lens import Lens
from tests.jobs.listener import Listener
from tests.support.splats import ball_of_splats

SEEN = ComparedViews(cameras="cameras.json")


def test_figures_and_pages(folder: Path, listener: Listener) -> None:
    compared = compare_files(
        "a.npz", "a.svo.pb", seen=SEEN, pages=ComparisonOutputs(sheet="a.png", html="a.html"), steps=listener
    )
    assert [view["name"] for view in compared.found.views] == ["0000", "0001", "0002"]
    assert compared.a["bytes"] == (folder / "a.npz").stat().st_size
    assert compared.b["format"] == "svo.pb"
    assert load("a.png", Image).size[0] == 3 * 24 - 4
    assert f'<data value="{compared.found.means["a_b"]["psnr"]!r}">' in (folder / "a.html").read_text()
    assert listener.phases[:2] == ["reading a.npz", "reading a.svo.pb"]


@pytest.mark.usefixtures("folder")
def test_photographs_give_the_size() -> None:
    render_views("a.npz", "truth", ViewSelection(cameras="cameras.json", every=True, size=(10, 8)))
    compared = compare_files(
        "a.npz",
        "a.npz",
        seen=ComparedViews(cameras="cameras.json", truth="truth"),
        pages=ComparisonOutputs(sheet="sheet.png"),
    )
    assert compared.found.pictures[0][1].size == (10, 8)
    assert compared.found.means["a_truth"]["psnr"] > 50  # but for the rounding to 8 bits


@pytest.mark.usefixtures("folder")
def test_limits_are_judged_after_all_is_reported() -> None:
    save("b.svo.pb", build_octree(load("a.npz"), resolution=1))
    for limits in (ComparisonLimits(min_psnr=90), ComparisonLimits(max_error=1e-3)):
        reported: list[FileComparison] = []
        with pytest.raises(BudgetMissed, match=r"b\.svo\.pb: the picture"):
            compare_files("a.npz", "b.svo.pb", seen=SEEN, limits=limits, report=reported.append)
        assert len(reported) == 1


@pytest.mark.usefixtures("folder")
def test_pages_that_cannot_be_written_are_told_before_anything_is_read() -> None:
    Path("there.png").touch()
    with pytest.raises(UsageError, match="cannot be stdout, which gets the figures"):
        compare_files("none", "none", pages=ComparisonOutputs(html="-"))
    with pytest.raises(UsageError, match="has no file extension for a picture"):
        compare_files("none", "none", pages=ComparisonOutputs(sheet="a.html"))
    with pytest.raises(OutputError, match="exists already"):
        compare_files("none", "none", pages=ComparisonOutputs(sheet="there.png"))


def test_stdin_cannot_be_both_scenes() -> None:
    with pytest.raises(UsageError, match="both scenes are stdin, which can be read once; allowed: '-' for one of them"):
        compare_files("-", "-")


@pytest.mark.usefixtures("folder")
def test_photographs_count_in_the_allowance_all_together() -> None:
    render_views("a.npz", "truth", ViewSelection(cameras="cameras.json", every=True, size=(300, 300)))
    small = ComparedViews(cameras="cameras.json", truth="truth", size=(4, 4))
    with memory_limit(6_000_000):
        for name in ("0000", "0001", "0002"):
            load(f"truth/{name}.png", Image)
        with pytest.raises(
            MemoryLimit, match=r"^truth/000[12]\.png: .* in addition to .* in use; .*\(`memory_limit`\)"
        ):
            compare_files("a.npz", "a.npz", seen=small)


@pytest.mark.usefixtures("folder")
def test_cameras_count_in_the_allowance() -> None:
    Path("cameras.json").write_text(Path("cameras.json").read_text() + " " * 1_000_000)
    with memory_limit(1_000_000), pytest.raises(MemoryLimit, match=r"^cameras\.json: the file needs"):
        compare_files("a.npz", "a.npz", seen=SEEN)


@pytest.mark.usefixtures("folder")
def test_a_camera_that_cannot_be_drawn_is_blamed_on_the_file_of_the_cameras() -> None:
    cameras = load("cameras.json", Cameras)
    first = cameras.cameras[0]
    save("long.json", replace(cameras, cameras=(replace(first, focal=9e8),)))
    wide = replace(first, lens=Lens("polynomial", (-30.0,)), focal=10.0)
    save("wide.json", replace(cameras, cameras=(wide,)))
    for seen, said in (
        (ComparedViews(cameras="long.json", size=(900, 900)), r"^long\.json: camera 0000 has focal length 4\.05e\+10"),
        (ComparedViews(cameras="wide.json"), r"^wide\.json: camera 0000 shows nothing at pixel 0, 0"),
    ):
        with pytest.raises(InvalidScene, match=said):
            compare_files("a.npz", "a.npz", seen=seen)
    with pytest.raises(InvalidScene, match=r"^long\.json: camera 0000 has focal length"):
        render_views("a.npz", "a.png", ViewSelection(cameras="long.json", size=(900, 900)))
    with pytest.raises(InvalidScene, match=r"^long\.json: camera 0000 has focal length"):
        view_file("a.npz", "a.html", cameras="long.json")
    with pytest.raises(InvalidScene, match=r"^wide\.json: camera 0000 shows nothing"):
        judge_output("a.npz", load("a.npz"), Budget(min_psnr=1, cameras="wide.json"), made_from="a.npz")


UTM = np.array([453000.125, 5012345.625, 120.25])


def test_splats_and_meshes_on_a_map_are_compared_where_they_are(tmp_path: Path, listener: Listener) -> None:
    ball = ball_of_splats(60)
    scenes = {
        "far.ply": replace(ball, origin=UTM),
        "near.spz": replace(ball, means=ball.means + np.array([0.125, -0.375, 0.25], np.float32)),
        "float.ply": replace(ball, means=(ball.means + UTM).astype(np.float32)),
        "beside.ply": replace(ball, origin=UTM + np.array([0.75, 0, 0])),
    }
    for name, scene in scenes.items():
        save(tmp_path / name, scene)

    def psnr(one: str, other: str, cameras: str | None = None) -> float:
        seen = ComparedViews(cameras=cameras, size=(24, 24))
        found = compare_files(tmp_path / one, tmp_path / other, seen=seen, steps=listener).found
        return float(found.means["a_b"]["psnr"])

    assert psnr("far.ply", "far.ply") == 100
    assert psnr("far.ply", "beside.ply") < 25
    assert listener.said == []
    assert psnr("far.ply", "near.spz") > 30  # .spz could not keep the origin
    told = "has no origin; it is taken as relative to 453000 5012346 120"
    assert listener.said == [f"{tmp_path / 'near.spz'}: {told}"]
    listener.said.clear()
    assert 10 < psnr("float.ply", "far.ply") < 60  # rounded to half a unit, where it is
    assert listener.said == []
    # Cameras of a capture are in the world of the file.
    cameras = orbit_cameras(load(tmp_path / "far.ply", Splats), frames=2, width=24, height=24)
    save(tmp_path / "cameras.json", cameras.relative_to(-load(tmp_path / "far.ply", Splats).origin))
    assert psnr("far.ply", "near.spz", str(tmp_path / "cameras.json")) > 30
