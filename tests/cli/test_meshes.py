"""Meshes and folders on the command line: info, check, compare, and an atlas's budget in pictures."""

from __future__ import annotations

import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from nerfbake import Meshes, Stage1, load, orbit_cameras, save
from nerfbake.cli.main import run
from tests.support.atlas_scenes import stage1_folder
from tests.support.meshes import cube, sphere


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stage-1 folder, `in`, and an atlas of it, `out`."""
    folder = tmp_path_factory.mktemp("sample")
    assert run(["sample", "nerf2mesh", str(folder / "in"), "--resolution", "64", "-q"]) == 0
    assert run(["atlas", str(folder / "in"), str(folder / "out"), "--clusters", "8", "-q"]) == 0
    return folder


def told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    capsys.readouterr()
    assert run([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_an_atlas_against_the_mlp_in_pictures(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [str(sample / "in"), str(sample / "out")]
    sheet = sample / "sheet.png"
    errors = told(["compare", *folders, "--size", "48x48", "--sheet", str(sheet)], capsys)["mean"]["a_b"]
    assert 25 < errors["psnr"] < 60
    assert sheet.stat().st_size > 1000
    assert told(["compare", folders[0], folders[0], "--size", "48x48"], capsys)["mean"]["a_b"]["psnr"] == 100
    assert run(["compare", *folders, "--size", "48x48", "--min-psnr", "90"]) == 3
    # Of the mesh inside scene.glb only the diffuse look is shown: it is further off than the atlas.
    flat = told(["compare", folders[0], str(sample / "out" / "scene.glb"), "--size", "48x48"], capsys)["mean"]["a_b"]
    assert flat["psnr"] < errors["psnr"] - 3


def test_an_atlas_that_misses_its_budget_is_kept_as_rejected(
    sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(sample / "cameras.json", orbit_cameras(load(sample / "in", Stage1), frames=2, width=40, height=40), force=True)
    arguments = ["atlas", str(sample / "in"), str(tmp_path / "out"), "--clusters", "2", "--map-size", "8"]
    arguments += ["--cameras", str(sample / "cameras.json")]
    for _ in range(2):  # the second time there is a rejected one already
        assert run([*arguments, "--min-psnr", "80"]) == 3
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith(f"error: {tmp_path}/out: the picture has a mean PSNR of ")
        assert [path.name for path in tmp_path.iterdir()] == ["out.rejected"]
    assert (tmp_path / "out.rejected" / "atlas.json").exists()
    assert run([*arguments, "--min-psnr", "10"]) == 0
    assert f"dB against {sample}/in" in capsys.readouterr().err


def test_without_a_mesh_no_budget_is_promised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = stage1_folder(tmp_path / "in", mesh_0_obj=None)
    assert run(["atlas", str(folder), str(tmp_path / "out"), "--clusters", "3", "--min-psnr", "10"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}: mesh_0.obj is missing; allowed: ")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_info_and_check_of_a_mesh(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path / "a.glb", Meshes((cube(), sphere())))
    facts = told(["info", str(tmp_path / "a.glb")], capsys)
    assert (facts["kind"], facts["format"], facts["meshes"]) == ("triangle mesh", "glb", 2)
    assert facts["world_box"] == [[-1, -1, -1], [1, 1, 1]]
    assert run(["check", str(tmp_path / "a.glb")]) == 0
    save(tmp_path / "a.obj", Meshes((cube(),)))

    class Stdin:
        buffer = io.BytesIO((tmp_path / "a.obj").read_bytes())

    monkeypatch.setattr(sys, "stdin", Stdin)
    assert told(["info", "-"], capsys)["triangles"] == 12


def test_folders_say_what_they_are(sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(sample / "out")]) == 0
    assert run(["render", str(sample / "in"), "--out", str(tmp_path / "a.png")]) == 1
    assert "holds a stage-1 folder (`nerfbake atlas` bakes it); allowed: a PlenOctree" in capsys.readouterr().err
    assert run(["compare", str(tmp_path), str(sample / "in")]) == 1
    assert (
        "is a folder that nerfbake does not know; allowed: a file, or a folder with mlp.json" in capsys.readouterr().err
    )


def test_a_broken_diffuse_texture_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = stage1_folder(tmp_path / "in", feat0_0_png=b"\x89PNG")
    assert run(["atlas", str(folder), str(tmp_path / "out"), "--clusters", "3"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}: feat0_0.png cannot be read")


def test_an_atlas_without_its_mesh_says_so(sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(sample / "out", tmp_path / "out")
    (tmp_path / "out" / "mesh_0.obj").unlink()
    assert run(["compare", str(sample / "in"), str(tmp_path / "out"), "--size", "8x8"]) == 1
    assert f"error: {tmp_path}/out: mesh_0.obj is missing" in capsys.readouterr().err
