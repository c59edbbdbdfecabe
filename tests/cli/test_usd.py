"""USD as commands write and read it, with OpenUSD and without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import Cameras, Meshes, Splats, Volume, build_octree, build_vdb, installation, load, sample_n3tree, save
from nerfbake.cli.convert import convert
from nerfbake.cli.main import run
from nerfbake.cli.paths import declared
from nerfbake.cli.vdb import vdb
from tests.support.scenes import n3tree
from tests.support.splats import splats
from tests.support.usd import in_this_process as in_this_process
from tests.support.views import sample_views


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def without_openusd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "find_spec", lambda name: None)


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
@pytest.mark.usefixtures("in_this_process")
def test_splats_become_usd_and_come_back(ending: str, capsys: pytest.CaptureFixture[str]) -> None:
    save("a.ply", splats(20, degree=3))
    assert run(["convert", "a.ply", f"a.{ending}"]) == 0
    assert "nothing is lost but the rounding of float32" in capsys.readouterr().err
    for back in ("ply", "spz", "glb"):
        assert run(["convert", f"a.{ending}", f"b.{back}"]) == 0
    assert np.array_equal(load("b.ply", Splats).means, load("a.ply", Splats).means)
    assert np.array_equal(load("b.ply", Splats).sh, load("a.ply", Splats).sh)
    assert run(["convert", "a.ply", f"half.{ending}", "--half"]) == 0
    assert "largest (median) loss: centres 0 (0) world units, scales 0.0" in capsys.readouterr().err
    assert run(["info", f"a.{ending}"]) == 0
    assert run(["check", f"a.{ending}"]) == 0


def test_options_that_do_not_fit_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    save("a.ply", splats(3))
    save("cameras.json", sample_views(frames=2, width=8, height=8).cameras)
    for arguments, said in (
        (["a.ply", "b.spz", "--half"], "spz takes no option 'half'"),
        (["a.ply", "b.usdz", "--small"], "usdz takes no option 'small'; allowed: half (True, False)"),
        (["a.ply", "b.usdz", "--grid", "density"], "splats have no child slots, grids and codecs"),
        (
            ["cameras.json", "b.usda", "--half"],
            "--half is for splats, but cameras.json holds cameras; allowed: --in-up",
        ),
        (["cameras.json", "b.usda", "--in-up", "x"], "option 'up' of usda is 'x'; allowed: z, y"),
    ):
        assert run(["convert", *arguments]) == 2
        assert said in capsys.readouterr().err
    assert not list(Path().glob("b.*"))


@pytest.mark.usefixtures("without_openusd")
def test_writing_needs_no_openusd_and_reading_names_the_extra(capsys: pytest.CaptureFixture[str]) -> None:
    save("a.ply", splats(5))
    assert run(["convert", "a.ply", "a.usdz"]) == 0
    assert "nothing is lost but the rounding" in capsys.readouterr().err
    save("cameras.json", sample_views(frames=2, width=8, height=8).cameras)
    assert run(["convert", "cameras.json", "cameras.usda"]) == 0
    capsys.readouterr()
    assert run(["info", "a.usdz"]) == 2
    said = capsys.readouterr().err
    assert "a.usdz: reading USD needs pxr, which is not installed; allowed: " in said
    assert "[usd]" in said


@pytest.mark.usefixtures("without_openusd")
def test_a_fit_that_could_not_be_measured_does_not_start(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fit", "photographs", "toy.usdz"]) == 2
    assert "measuring the file that fit wrote needs pxr, which is not installed" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("without_openusd")
def test_a_mesh_and_splats_are_measured_without_openusd(capsys: pytest.CaptureFixture[str]) -> None:
    save("a.npz", sample_n3tree(resolution=16))
    small = ["--frames", "8", "--edge", "32"]
    assert run(["mesh", "a.npz", "a.usdz", "--triangles", "200", "--texture", "32", *small]) == 0
    assert run(["splats", "a.npz", "s.usdc", "--count", "200", "--epochs", "1", *small]) == 0
    assert capsys.readouterr().err.count(" dB, SSIM ") == 2


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_meshes_and_splats_of_a_scene_stand_upright() -> None:
    save("a.npz", sample_n3tree(resolution=16))
    small = ["--frames", "8", "--edge", "32"]
    assert run(["mesh", "a.npz", "a.usda", "--triangles", "200", "--texture", "32", *small]) == 0
    assert {path.name for path in Path().glob("a.*")} == {"a.npz", "a.usda", "a.jpg"}
    assert '    upAxis = "Y"\n' in Path("a.usda").read_text()
    assert run(["mesh", "a.npz", "a.glb", "--triangles", "200", "--texture", "32", *small]) == 0
    ours, other = (load(name, Meshes).meshes[0] for name in ("a.usda", "a.glb"))
    assert np.allclose(ours.positions.mean(axis=0), other.positions.mean(axis=0), atol=1e-3)  # the field's own axes
    assert run(["splats", "a.npz", "s.usda", "--count", "200", "--epochs", "1", *small]) == 0
    assert '    upAxis = "Z"\n' in Path("s.usda").read_text()
    assert load("s.usda", Splats).up == "z"


@pytest.mark.usefixtures("in_this_process")
def test_a_stage_gives_its_cameras_to_other_commands() -> None:
    save("a.npz", sample_n3tree(resolution=8))
    save("cameras.json", sample_views(frames=2, width=8, height=8).cameras)
    assert run(["convert", "cameras.json", "cameras.usdz"]) == 0
    assert run(["render", "a.npz", "--cameras", "cameras.usdz", "--all", "--out", "pictures"]) == 0
    assert len(list(Path("pictures").glob("*.png"))) >= 2
    assert len(load("cameras.usdz", Cameras).cameras) == 2


def test_a_batch_knows_the_vdb_beside_a_stage() -> None:
    assert declared(vdb, ["a.npz", "out/a.usda"]).writes == ("out/a.usda",)
    assert "out/a.vdb" in declared(vdb, ["a.npz", "out/a.usda"]).spare
    assert "out/a.vdb" in declared(convert, ["smoke.nvdb", "out/a.usda"]).spare


@pytest.mark.usefixtures("without_openusd")
def test_any_volume_gets_a_stage_beside_its_vdb(capsys: pytest.CaptureFixture[str]) -> None:
    volume = build_vdb(build_octree(n3tree()), grids=("density",))
    save("smoke.nvdb", volume)
    assert run(["convert", "smoke.nvdb", "smoke.usda"]) == 0
    assert "smoke.usda: z is up in the stage; smoke.nvdb does not say its axis, so name it by --in-up\n" in (
        capsys.readouterr().err
    )
    assert "float3[] extent" in Path("smoke.usda").read_text()
    assert load("smoke.vdb", Volume).labels == volume.labels
    assert run(["convert", "smoke.nvdb", "y.usdc", "--in-up", "y", "--half"]) == 0
    assert "does not say" not in capsys.readouterr().err
    assert np.allclose(load("y.vdb", Volume).transform, volume.turned().transform)
    for words, told in (
        ("smoke.vdb smoke.usda", "smoke.usda: exists already"),
        ("smoke.vdb new.usdz", "a .usdz cannot contain a .vdb; allowed: .usda or .usdc"),
        ("smoke.vdb new.usda --in-axes RDF", "--in-axes is for splats, but smoke.vdb holds a volume; allowed: --in-up"),
    ):
        assert run(["convert", *words.split()]) != 0
        assert told in capsys.readouterr().err
