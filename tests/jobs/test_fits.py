"""From photographs to a scene: what stands around the trainer, with one that takes no time."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
import zipfile
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest

from nerfbake import Meshes, N3Tree, SparseVoxelOctree, Splats, Volume, build_field, io, load, measure_views
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit, NerfbakeError, OutputError, Stopped, UsageError
from nerfbake.jobs import (
    ComparedViews,
    FitOptions,
    FitResult,
    PhotographOptions,
    Source,
    Target,
    compare_files,
    fit_file,
)
from nerfbake.jobs.compressions import CompressionGoal, GroundTruth, compress_file
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.schedule import preset_schedule
from tests.jobs.fake_fit import FakeFit, fake_fit
from tests.jobs.listener import Listener
from tests.support.photographs import write_scene


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("capture") / "scene")


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeFit:
    monkeypatch.chdir(tmp_path)
    return fake_fit(monkeypatch)


@pytest.mark.usefixtures("trainer")
def test_the_file_is_judged_as_anybody_would_read_it(capture: Path, listener: Listener) -> None:
    fitted = fit_file(capture, "a.npz", steps=listener)
    held_out = read_photographs(SILENT, Source(str(capture))).held_out
    assert fitted.views == measure_views(build_field(load("a.npz", N3Tree)), held_out, samples=2)
    assert fitted.psnr == pytest.approx(np.mean([view.psnr for view in fitted.views]), abs=1e-12)
    assert fitted.ssim == pytest.approx(np.mean([view.ssim for view in fitted.views]), abs=1e-12)
    assert fitted.bytes == Path("a.npz").stat().st_size
    assert listener.said[-1].startswith(f"a.npz: {fitted.psnr:.2f} dB, SSIM {fitted.ssim:.4f} on 4 pictures")
    assert "2x2 rays a pixel" in listener.said[-1]


@pytest.mark.usefixtures("trainer")
def test_what_judged_a_fit_measures_its_compression(capture: Path) -> None:
    fitted = fit_file(capture, "a.npz")
    found = compress_file("a.npz", "a.svoq", goal=CompressionGoal(step=0.5))
    assert found.measured
    assert found.views == len(fitted.views)
    assert found.source_psnr == pytest.approx(fitted.psnr, abs=0.02)  # of photographs in 8 bits
    held_out = read_photographs(SILENT, Source(str(capture))).held_out
    lost = measure_views(build_field(load("a.svoq")), held_out, samples=2)
    assert found.loss == pytest.approx(fitted.psnr - np.mean([view.psnr for view in lost]), abs=0.02)
    predicted = compress_file(
        "a.npz", "b.svoq", goal=CompressionGoal(step=0.5), photographs=GroundTruth(source_psnr=30)
    )
    assert not predicted.measured


@pytest.mark.usefixtures("trainer")
def test_a_plenoctree_is_written_as_svox_writes_it(capture: Path) -> None:
    half, full = fit_file(capture, "half.npz"), fit_file(capture, "full.npz", dtype="float32")
    assert [load(name, N3Tree).data.dtype for name in ("half.npz", "full.npz")] == [np.float16, np.float32]
    assert half.psnr == pytest.approx(full.psnr, abs=0.01)
    assert half.bytes < full.bytes
    with zipfile.ZipFile("half.npz") as archive:
        assert {member.compress_type for member in archive.infolist()} == {zipfile.ZIP_DEFLATED}
    with pytest.raises(UsageError, match=r"`dtype` has no effect on a\.svo\.pb; allowed: with a PlenOctree"):
        fit_file(capture, "a.svo.pb", dtype="float32")


@pytest.mark.usefixtures("trainer")
def test_values_that_float16_cannot_hold_stay_float32(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.jobs.fits.LARGEST", 1e-3)
    fit_file(capture, "a.npz")
    assert load("a.npz", N3Tree).data.dtype == np.float32


@pytest.mark.usefixtures("trainer")
def test_compare_finds_what_was_said(capture: Path) -> None:
    fitted = fit_file(capture, "a.npz")
    seen = ComparedViews(cameras=str(capture / "transforms_test.json"), truth=str(capture / "test"), samples=2)
    means = compare_files("a.npz", "a.npz", seen=seen).found.means["a_truth"]
    assert (means["psnr"], means["ssim"]) == pytest.approx((fitted.psnr, fitted.ssim), abs=1e-9)


@pytest.mark.usefixtures("trainer")
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.npz", N3Tree), ("a.svo.npz", SparseVoxelOctree), ("a.svo.pb.zst", SparseVoxelOctree), ("a.nvdb", Volume),
        ("a.vdb.npz", Volume), ("a.svoq", SparseVoxelOctree),
    ],
)  # fmt: skip
def test_every_ending_holds_the_same_field(name: str, kind: type, capture: Path) -> None:
    fitted = fit_file(capture, name)
    assert type(load(name)) is kind
    lost = 0.3 if name.endswith(".svoq") else 0.02
    assert fitted.psnr == pytest.approx(fit_file(capture, "other.npz").psnr, abs=lost)


@pytest.mark.usefixtures("trainer")
def test_a_vdb_has_the_grids_that_blender_reads(capture: Path) -> None:
    fitted = fit_file(capture, "a.vdb")
    assert load("a.vdb").labels == ["density", "Cd"]
    assert fitted.psnr == pytest.approx(fit_file(capture, "other.npz").psnr, abs=1)  # one colour in all directions


@pytest.mark.usefixtures("trainer")
def test_splats_stand_upright_in_the_file(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Splats] = []

    def unfitted(steps: Any, source: Any, splats: Splats, *others: Any) -> Splats:
        built.append(splats)
        return splats

    monkeypatch.setattr("nerfbake.jobs.fits.fitted_splats", unfitted)
    fitted = fit_file(capture, "a.ply")
    found = load("a.ply", Splats)
    assert found.up in (None, "-y")
    np.testing.assert_allclose(found.means, built[0].with_up("z").means, atol=1e-6)
    held_out = read_photographs(SILENT, Source(str(capture))).held_out
    assert fitted.views == measure_views(found.without_up("z"), held_out)


@pytest.mark.long  # three textures of 2048 x 2048
@pytest.mark.usefixtures("trainer")
def test_a_fit_ends_in_a_textured_mesh(capture: Path, listener: Listener) -> None:
    fitted = fit_file(capture, "a.obj", steps=listener)
    (mesh,) = load("a.obj", Meshes).meshes
    assert mesh.texture is not None
    assert mesh.texture.shape == (2048, 2048, 3)
    assert fitted.psnr > 18
    assert any("silhouettes' IoU 0.9" in line for line in listener.said)
    assert {path.name for path in Path().glob("a.*")} == {"a.obj", "a.mtl", "a.jpg"}


def test_what_cannot_be_written_is_told_before_anything_is_read(trainer: FakeFit) -> None:
    Path("there.npz").touch()
    for target, said in (
        ("-", "fit measures the file that it wrote; allowed: an OUT other than '-'"),
        ("a.png", r"'a\.png' is not the extension of a field or a mesh; allowed: \.svo\.npz, .*, or `to=FORMAT`"),
    ):
        with pytest.raises(UsageError, match=said):
            fit_file("none", target)
    with pytest.raises(OutputError, match="exists already"):
        fit_file("none", "there.npz")
    with pytest.raises(UsageError, match="`preset` and `minutes` each select a schedule; allowed: one of them"):
        fit_file("none", "a.npz", options=FitOptions(preset="fast", minutes=1.0))
    with pytest.raises(UsageError, match="`test` and `holdout` both select"):
        fit_file("none", "a.npz", photographs=PhotographOptions(test="a", holdout=3))
    with pytest.raises(OutputError, match=r"there\.npz: File exists"):
        fit_file("none", "a.npz", state="there.npz")
    Path("a.jpg").touch()
    with pytest.raises(OutputError, match=r"a\.jpg: exists already"):
        fit_file("none", "a.obj")
    assert trainer.asked == []


def test_the_trainer_is_asked_for_what_was_asked_for(trainer: FakeFit, capture: Path) -> None:
    box = (-1.0, -2.0, -3.0, 1.0, 2.0, 3.0)
    fit_file(
        capture,
        Target("a", to="npz"),
        photographs=PhotographOptions(holdout=4),
        options=FitOptions(basis="SH1", samples=1, box=box, seed=7),
    )
    (asked,) = trainer.asked
    assert (asked["basis"], asked["box"].tolist(), asked["seed"]) == ("SH1", [[-1, -2, -3], [1, 2, 3]], 7)
    assert asked["schedule"] == preset_schedule("balanced", samples=1, views=12)
    assert len(asked["views"].pictures) == 12


@pytest.mark.parametrize(
    ("options", "basis"),
    [
        (FitOptions(), "SH9"),
        (FitOptions(preset="fast"), "SH9"),
        (FitOptions(preset="best"), "SH16"),
        (FitOptions(preset="best", basis="SH4"), "SH4"),
    ],
)
def test_the_preset_best_has_another_band(trainer: FakeFit, capture: Path, options: FitOptions, basis: str) -> None:
    fit_file(capture, Target("a", to="npz"), options=options)
    assert trainer.asked[0]["basis"] == basis


def test_a_preset_and_its_printed_schedule_are_measured_with_the_same_rays() -> None:
    schedule = FitOptions().schedule()
    assert schedule[-1].rays == 3
    assert FitOptions().rays(schedule) == FitOptions(epochs=str(schedule)).rays(schedule) == 2


@pytest.mark.usefixtures("trainer")
def test_progress_tells_where_it_is_and_how_near(capture: Path, listener: Listener) -> None:
    fitted = fit_file(capture, "a.npz", steps=listener)
    shares, details = zip(*(each for each in listener.shares if each[1]), strict=True)  # not those of judging
    assert list(shares) == sorted(shares)
    assert 0 < shares[0] < shares[-1] == pytest.approx(1)
    assert details[0] == "stage 1 of 5, 16^3, 7 voxels"
    seen = fitted.curve[-1].psnr
    assert details[-1].endswith(f"^3, 7 voxels, {seen:.2f} dB on 4 of 4 held-out views")


def broken_after(trainer: FakeFit, step: int) -> None:
    def stop() -> None:
        raise RuntimeError("killed")

    trainer.at_step[step] = stop


def test_a_killed_run_goes_on_where_it_was(trainer: FakeFit, capture: Path) -> None:
    whole = fit_file(capture, "whole.npz", state="unbroken")
    taken = trainer.steps
    trainer.steps = 0
    trainer.at_step[1] = lambda: time.sleep(0.3)
    broken_after(trainer, 8)
    with pytest.raises(RuntimeError, match="killed"):
        fit_file(capture, "a.npz", state="state")
    assert not Path("a.npz").exists()
    trainer.at_step.clear()
    again = fit_file(capture, "a.npz", state="state")
    assert trainer.asked[-1]["start"] is not None
    assert trainer.steps < 8 + taken
    assert Path("a.npz").read_bytes() == Path("whole.npz").read_bytes()
    assert again.worked > 0
    assert again.passed > 0.3  # that of the killed run is included
    assert [point[2:] for point in again.curve[:1]] == [point[2:] for point in whole.curve[:1]]
    trainer.steps = 0
    fit_file(capture, Target("a.npz", force=True), state="state")  # nothing is left to do
    assert trainer.steps == 0
    assert Path("a.npz").read_bytes() == Path("whole.npz").read_bytes()


@pytest.mark.parametrize(
    ("photographs", "options", "said"),
    [
        (
            PhotographOptions(),
            FitOptions(seed=1),
            r"the fit's seed was 0; allowed: the same as now \(1\), or another `state`",
        ),
        (PhotographOptions(), FitOptions(basis="SH4"), r"the fit's basis was SH9; allowed: the same as now \(SH4\)"),
        (PhotographOptions(), FitOptions(box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)), r"the fit's box was None"),
        (PhotographOptions(holdout=4), FitOptions(), r"the fit's schedule was cells=64"),
        (
            PhotographOptions(background=(0.0, 0.0, 0.0)),
            FitOptions(),
            r"the fit had other pictures, cameras or points; allowed: the same, or",
        ),
    ],
)
@pytest.mark.usefixtures("trainer")
def test_a_state_of_another_fit_is_refused(
    photographs: PhotographOptions, options: FitOptions, said: str, capture: Path
) -> None:
    fit_file(capture, "a.npz", state="state")
    with pytest.raises(InvalidFile, match=r"^state/checkpoint\.npz: " + said):
        fit_file(capture, "b.npz", photographs=photographs, options=options, state="state")
    assert not Path("b.npz").exists()


HOSTILE: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "no facts": ({"key": None}, {}, "the fit's checkpoint format was nothing"),
    "a negative time": ({"worked": -1}, {}, "worked is -1; allowed: a number of seconds"),
    "no time": ({"worked": "long"}, {}, "worked is long"),
    "a time of nothing": ({"passed": None}, {}, "passed is None; allowed: a number of seconds"),
    "a curve of text": ({"curve": [["a"] * 6]}, {}, "curve is no list of points; allowed: 6 numbers each"),
    "a short curve": ({"curve": [[1]]}, {}, "curve is no list of points"),
    "no devices": ({"devices": []}, {}, "devices is \\[\\]; allowed: a list of names"),
    "other arrays": ({}, {"at": np.ones(3)}, "at is no state"),
    "more arrays": ({}, {"more": np.ones(3)}, "at is no state"),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.usefixtures("trainer")
def test_a_hostile_state_is_refused_in_one_line(name: str, capture: Path) -> None:
    fit_file(capture, "a.npz", state="state")
    found = io.load_checkpoint("state")
    assert found is not None
    facts, arrays, said = HOSTILE[name]
    io.save_checkpoint("state", found[0] | facts, found[1] | arrays)
    with pytest.raises(NerfbakeError, match=r"^state/checkpoint\.npz: " + said):
        fit_file(capture, "b.npz", state="state")


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_writes_what_there_is(trainer: FakeFit, capture: Path, listener: Listener) -> None:
    before = signal.getsignal(signal.SIGINT)
    trainer.at_step[5] = interrupt
    for target in (Target("a.svo.pb"), Target("b", to="npz.zst")):
        trainer.steps = 0
        with pytest.raises(Stopped) as stopped:
            fit_file(capture, target, steps=listener)
        assert stopped.value.exit_code == 130
        assert str(stopped.value) == f"stopped before the end: {target.path}.partial has the current state"
    assert sorted(path.name for path in Path().iterdir()) == ["a.svo.pb.partial", "b.partial"]
    assert isinstance(load("b.partial"), N3Tree)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("trainer")
@pytest.mark.parametrize(
    ("slow", "said", "left"),
    [
        ("nerfbake.jobs.fits.build_n3tree", r"before the end: a\.npz\.partial has the current state", "a.npz.partial"),
        ("nerfbake.io.saving", r"before the quality was measured: a\.npz is complete", "a.npz"),
    ],
)
def test_ctrl_c_loses_nothing_while_what_was_fitted_is_made_and_written(
    slow: str, said: str, left: str, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = resolve_name(slow)

    def interrupted(*arguments: Any, **options: Any) -> Any:
        interrupt()
        return work(*arguments, **options)

    monkeypatch.setattr(slow, interrupted)
    with pytest.raises(Stopped, match=said):
        fit_file(capture, "a.npz")
    assert [path.name for path in Path().iterdir()] == [left]


@pytest.mark.usefixtures("trainer")
@pytest.mark.parametrize("error", [MemoryLimit("the pictures", 2, 1), KeyboardInterrupt()])
def test_what_was_fitted_is_kept_if_it_cannot_be_measured(
    error: BaseException, capture: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr("nerfbake.jobs.fits.measure_views", fail)
    for _ in range(2):  # the second one replaces what the first one has kept
        with pytest.raises(type(error)):
            fit_file(capture, "a.npz", steps=listener)
        assert listener.said[-1] == "a.npz.partial: is complete, but was not measured"
        assert [path.name for path in Path().iterdir()] == ["a.npz.partial"]
    Path("a.npz.partial").rename("a.npz")
    assert isinstance(load("a.npz"), N3Tree)


def test_what_ctrl_c_has_stopped_goes_on_from_its_state(trainer: FakeFit, capture: Path) -> None:
    fit_file(capture, "whole.npz")
    trainer.steps, trainer.at_step[3] = 0, interrupt
    with pytest.raises(
        Stopped, match=r"a\.npz\.partial has the current state; run the same command to resume from state$"
    ):
        fit_file(capture, "a.npz", state="state")
    fit_file(capture, "a.npz", state="state")
    assert trainer.asked[-1]["start"].done == 2
    assert Path("a.npz").read_bytes() == Path("whole.npz").read_bytes()


def test_a_second_ctrl_c_ends_at_once(trainer: FakeFit, capture: Path) -> None:
    def twice() -> None:
        interrupt()
        interrupt()

    trainer.at_step[2] = twice
    with pytest.raises(KeyboardInterrupt):
        fit_file(capture, "a.npz")
    assert not list(Path().iterdir())


def test_what_is_wrong_with_a_capture_is_blamed_on_it(
    trainer: FakeFit, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*views: Any, **options: Any) -> Any:
        raise InvalidScene("the cameras see nothing in common; allowed: views of one object")

    monkeypatch.setattr("nerfbake.stages.views_to_field.fit_field", refuse)
    with pytest.raises(InvalidScene, match="scene: the cameras see nothing in common"):
        fit_file(capture, "a.npz")
    assert not trainer.asked


def moved_capture(capture: Path, place: Path, metres: float) -> Path:
    """A copy of a capture in coordinates of a map: float32 resolves half a metre at 5,000 km."""
    moved = Path(shutil.copytree(capture, place))
    for path in moved.glob("transforms_*.json"):
        fields = json.loads(path.read_text())
        for frame in fields["frames"]:
            frame["transform_matrix"][1][3] += metres
        path.write_text(json.dumps(fields))
    return moved


@pytest.mark.usefixtures("trainer")
@pytest.mark.parametrize(("metres", "told"), [(5_000_000, True), (500_000, True), (50, False)])
def test_cameras_far_from_the_origin_are_fitted_near_it(
    metres: float, told: bool, capture: Path, tmp_path: Path, listener: Listener
) -> None:
    moved = moved_capture(capture, tmp_path / "moved", metres)
    fit_file(moved, "a.npz", steps=listener)
    said = [line for line in listener.said if "far from 0" in line]
    assert bool(said) == told
    if told:
        assert said[0].startswith(
            f"{moved}: the cameras are far from 0; the fit is relative to 0 {metres:,}".replace(",", "")
        )


@pytest.mark.slow
def test_a_fit_on_a_map_is_the_fit_at_home(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listener: Listener
) -> None:
    """An octree 5,000 km away has the coordinates of the map. A PlenOctree in float32 is relative to its origin."""
    monkeypatch.chdir(tmp_path)
    quick = FitOptions(epochs="cells=8,prune=0.03/cells=16,rays=1,prune=0.02", basis="SH1")
    moved = moved_capture(capture, tmp_path / "moved", 5_000_000.0)
    home, away, tree = (
        fit_file(path, name, options=quick, steps=listener)
        for path, name in ((capture, "home.svo.npz"), (moved, "away.svo.npz"), (moved, "away.npz"))
    )
    assert away.psnr == pytest.approx(home.psnr, abs=1e-3)
    assert tree.psnr == pytest.approx(home.psnr, abs=0.05)  # its values are float16
    octrees = [load(name, SparseVoxelOctree) for name in ("home.svo.npz", "away.svo.npz")]
    assert octrees[1].origin - octrees[0].origin == pytest.approx([0, 5_000_000, 0], abs=1e-6)
    lost = "away.npz: positions are relative to the origin 0 5000000 0, which .npz cannot keep"
    assert lost in listener.said


@pytest.mark.usefixtures("trainer")
def test_a_report_gets_what_is_returned(capture: Path) -> None:
    told: list[FitResult] = []
    assert [fit_file(capture, "a.npz", report=told.append)] == told
