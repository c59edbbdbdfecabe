"""Shipments: every file of the list is made, judged in the world of the scene, and a failure is one row."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Splats, build_octree, build_vdb, io, jobs, load, sample_n3tree, save
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, Stopped, UsageError
from nerfbake.jobs import shipments
from nerfbake.jobs.shipping_list import FILES, TARGETS
from nerfbake.scene.shipment import Shipment
from tests.jobs.listener import Listener
from tests.support.compression import with_fewer_rays
from tests.support.functions import soft_file
from tests.support.lattices import svox2, svox2_file
from tests.support.outputs import read_output
from tests.support.splats import ball_of_splats
from tests.support.usd import in_this_process as in_this_process

FEW: Any = {
    "pictures": jobs.ShippedViews(frames=2, edge=16),
    "options": jobs.ShipmentOptions(splats=60, triangles=100, texture=16),
}
FAST = {
    "nerfbake.jobs.splat_voxels.RESOLUTION": 16,
    "nerfbake.jobs.splat_voxels._FRAMES": 2,
    "nerfbake.jobs.splat_voxels._EDGE": 16,
    "nerfbake.jobs.splat_voxels._JUDGES": 1,
    "nerfbake.jobs.readings._EDGE": 16,
    "nerfbake.jobs.function_voxels.RESOLUTION": 16,
    "nerfbake.jobs.function_voxels._EDGE": 4,
    "nerfbake.scene.function_field._COARSE_GRID": 16,
    "nerfbake.stages.function_to_part._RESOLUTION": 16,
    "nerfbake.stages.function_to_image.STEPS": 32,
}
pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.npz", sample_n3tree(resolution=8, basis="SH4"))
    with_fewer_rays(monkeypatch)
    for name, value in FAST.items():
        monkeypatch.setattr(name, value)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Shipment, Listener]:
    """A shipment for all targets, and what was said."""
    folder, listener = tmp_path_factory.mktemp("whole"), Listener()
    save(folder / "a.npz", sample_n3tree(resolution=8, basis="SH4"))
    with pytest.MonkeyPatch.context() as patch:
        with_fewer_rays(patch)
        found = jobs.ship_file(folder / "a.npz", folder / "out", targets=tuple(TARGETS), steps=listener, **FEW)
    return folder / "out", found, listener


def rows(found: Shipment) -> dict[str, Any]:
    facts = read_output("ship", io.json_line(found.facts))
    return {row["file"]: row for row in facts["files"]}


@pytest.mark.long
def test_every_file_of_the_list_is_made_and_judged(whole: tuple[Path, Shipment, Listener]) -> None:
    folder, found, _ = whole
    assert {path.name for path in folder.iterdir()} == {*FILES, "report.html", "report.json"}
    assert [file.status for file in found.files] == ["judged"] * len(FILES)
    for name, row in rows(found).items():
        assert row["bytes"] == (folder / name).stat().st_size
        assert row["seconds"] >= 0
        assert row["worst"]["psnr"] <= row["psnr"]
        assert row["readers"]
        # Sideways, splats and meshes would have about as much as a white picture.
        assert row["psnr"] > 15, name
        assert 0 <= row["max_error"] <= 1
    for name in ("scene.svo.npz", "scene.svo.pb"):
        assert rows(found)[name]["psnr"] == 100
    assert rows(found)["scene.svoq"]["psnr"] > 40
    assert "read by usd-core" in rows(found)["mesh.usdz"]["judged_by"]
    assert rows(found)["scene.vdb"]["judged_by"].startswith("read back by nerfbake ")


@pytest.mark.long
def test_the_report_is_what_is_returned_and_messages_name_the_final_files(
    whole: tuple[Path, Shipment, Listener],
) -> None:
    folder, found, listener = whole
    assert json.loads((folder / "report.json").read_text()) == {"version": 1, **json.loads(json.dumps(found.facts))}
    assert any(line.startswith(f"{folder / 'scene.vdb'}: ") and "worst view" in line for line in listener.said)
    assert any(line.startswith(f"{folder.parent / 'a.npz'} as splats: ") for line in listener.said)
    assert not any(".part" in line for line in (*listener.said, (folder / "report.json").read_text()))


def test_a_message_names_the_command_of_an_option_that_ship_lacks(listener: Listener) -> None:
    steps = shipments._Renamed(listener, {"/tmp/a.part": "a.html"}).of("nerfbake view")
    steps.say("/tmp/a.part: `max_loss=0.5` makes a larger page, `frames=8` a faster one")
    assert listener.said == ["a.html: `max_loss=0.5` of `nerfbake view` makes a larger page, `frames=8` a faster one"]


@pytest.mark.long
def test_splats_of_all_formats_have_the_same_pictures(whole: tuple[Path, Shipment, Listener]) -> None:
    """So each stands in its own world as the scene does, and was turned back to be judged."""
    found = rows(whole[1])
    for name in ("splats.spz", "splats.sog", "splats.usdc"):
        assert found[name]["psnr"] == pytest.approx(found["splats.ply"]["psnr"], abs=0.5)
    assert len(whole[1].shared) == 1
    assert (whole[0] / "splats.spz").read_bytes()[:2] == b"\x1f\x8b"  # gzip, so version 3: more programs read it than 4


@pytest.mark.slow
def test_a_failed_file_is_a_row_and_the_others_are_there(listener: Listener) -> None:
    # Without colours: it becomes an octree in plain arrays, and `compress` refuses it.
    grey = build_vdb(build_octree(sample_n3tree(resolution=8, basis="SH4")), grids=("density",))
    save("grey.vdb", replace(grey, frame=None))
    seen: list[Shipment] = []
    with pytest.raises(NerfbakeError, match=r"^out: 1 of 3 files failed: scene\.svoq; allowed: report\.html has"):
        jobs.ship_file("grey.vdb", "out", targets=("archive",), steps=listener, report=seen.append, **FEW)
    assert [file.name for file in seen[0].failed] == ["scene.svoq"]
    row = rows(seen[0])["scene.svoq"]
    assert (row["status"], row["bytes"], row["psnr"], row["seconds"]) == ("failed", None, None, None)
    assert row["reason"] in (Path("out/report.json").read_text())
    assert f"out/scene.svoq: failed: {row['reason']}" in listener.said
    assert {path.name for path in Path("out").iterdir()} == {
        "scene.svo.npz",
        "splats.ply",
        "report.html",
        "report.json",
    }


def test_a_file_that_cannot_be_read_back_is_not_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    def write_rubbish(source: Any, path: Path, **options: Any) -> None:
        Path(path).write_bytes(b"rubbish")

    monkeypatch.setattr("nerfbake.jobs.shipments.bake_octree", write_rubbish)
    seen: list[Shipment] = []
    with pytest.raises(NerfbakeError, match=r"1 of 1 files failed: scene\.svo\.pb"):
        jobs.ship_file("a.npz", "out", targets=("unity",), report=seen.append)
    assert seen[0].files[0].reason.startswith("out/scene.svo.pb: ")
    assert {path.name for path in Path("out").iterdir()} == {"report.html", "report.json"}


def test_what_could_not_be_judged_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise MemoryLimit("the pictures", 2, 1)

    monkeypatch.setattr("nerfbake.jobs.shipments.compare_scenes", fail)
    row = rows(jobs.ship_file("a.npz", "out", targets=("unity",)))["scene.svo.pb"]
    assert (row["status"], row["psnr"], row["worst"], row["judged_by"]) == ("not judged", None, None, None)
    assert "the pictures needs 2 B" in row["reason"]
    assert row["bytes"] == Path("out/scene.svo.pb").stat().st_size
    assert "Not judged: " in Path("out/report.html").read_text()


@pytest.mark.slow
def test_without_openusd_its_files_are_made_and_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.jobs.shipments.is_installed", lambda name: False)
    monkeypatch.setattr("nerfbake.jobs.files.is_installed", lambda name: False)
    found = rows(jobs.ship_file("a.npz", "out", targets=("omniverse",), **FEW))
    assert {row["status"] for row in found.values()} == {"not judged"}
    assert found["mesh.usdz"]["reason"] == "reading it needs usd-core, which is not installed"
    assert Path("out/mesh.usdz").exists()


def test_a_shared_step_that_fails_runs_once_and_fails_its_files(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[int] = []

    def fail(*arguments: Any, **options: Any) -> None:
        runs.append(1)
        raise InvalidScene("the field is no good")

    monkeypatch.setattr("nerfbake.jobs.shipments.bake_splats", fail)
    seen: list[Shipment] = []
    with pytest.raises(NerfbakeError, match="2 of 3 files failed"):
        jobs.ship_file("a.npz", "out", targets=("web",), report=seen.append, **FEW)
    assert len(runs) == 1
    assert {file.reason for file in seen[0].failed} == {"the field is no good"}


def test_ctrl_c_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*arguments: Any, **options: Any) -> None:
        raise Stopped("stopped")

    monkeypatch.setattr("nerfbake.jobs.shipments.bake_octree", stop)
    with pytest.raises(Stopped):
        jobs.ship_file("a.npz", "out", targets=("unity",))
    assert {path.name for path in Path().iterdir()} == {"a.npz"}


@pytest.mark.slow
def test_splats_are_shipped_upright_and_judged_in_their_own_world() -> None:
    scene = replace(ball_of_splats(200), up="z")
    scene.means[:, 2] *= 3  # tall
    save("ball.ply", scene)
    found = rows(jobs.ship_file("ball.ply", "out", targets=("web", "archive")))
    upright = load("out/splats.ply", Splats)
    assert np.allclose(upright.means, scene.with_up("z").means)
    assert found["splats.ply"]["psnr"] > 60
    assert found["scene.svo.npz"]["psnr"] > 15  # of few voxels, but not of something that lies
    assert load("out/scene.svo.npz").size[2] == max(load("out/scene.svo.npz").size)
    for words in ({"cameras": "c"}, {"pictures": jobs.ShippedViews(views="c")}):
        with pytest.raises(UsageError, match=r"splats are turned upright, and `(cameras|views)` are not"):
            jobs.ship_file("ball.ply", "other", targets=("unity",), **words)


@pytest.mark.parametrize("kind", ["lattice", "function"])
def test_a_scene_that_becomes_voxels_becomes_them_once(kind: str) -> None:
    name = {"lattice": "a.ckpt.npz", "function": "soft.tar"}[kind]
    Path(name).write_bytes(svox2_file(svox2()) if kind == "lattice" else soft_file())
    found = jobs.ship_file(name, "out", targets=("unity",))
    assert [step.what for step in found.shared] == ["an octree" if kind == "lattice" else "the field, baked"]
    assert {file.status for file in found.files} == {"judged"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("a.npz", "out", ("blendr",)),
            "'blendr' is no target, perhaps 'blender' is meant; allowed: blender, web, ios",
        ),
        (("a.npz", "out", ()), "there is no target; allowed: blender, web"),
        (("-", "out", ("web",)), "ship reads IN several times; allowed: a file"),
    ],
)
def test_a_wrong_use_is_one_line(words: tuple[str, str, tuple[str, ...]], message: str) -> None:
    source, target, targets = words
    with pytest.raises(UsageError, match=message):
        jobs.ship_file(source, target, targets=targets)
    assert not Path("out").exists()
