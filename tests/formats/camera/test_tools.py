"""One rig in the camera files of every tool: the same rays, the same cameras, the same fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Cameras, catalog, load
from nerfbake.errors import InvalidFile
from tests.support import camera_tools
from tests.support.camera_tools import TOOLS, kept_by
from tests.support.captures import Rig, rig, write_nerfstudio, write_pictures

OWN_PICTURES = {"polycam", "record3d", "neus", "seven_scenes", "kapture", "euroc"}


@pytest.fixture(scope="module")
def made() -> Rig:
    return rig(odd=True)


def written(tool: str, folder: Path, made: Rig) -> tuple[str, Rig]:
    """Write a capture with its pictures, and return the file of cameras and the rig as the file stores it."""
    kept = kept_by(tool, made)
    if tool not in OWN_PICTURES:
        write_pictures(folder / "images", kept)
    return TOOLS[tool][0](folder, kept), kept


def test_every_line_of_the_catalog_is_written_here() -> None:
    assert set(TOOLS) == {form.name for form in catalog.DIALECTS}


@pytest.mark.parametrize("tool", TOOLS)
def test_the_rays_of_a_tool_are_those_of_its_rig(tool: str, made: Rig, tmp_path: Path) -> None:
    file, kept = written(tool, tmp_path, made)
    form = next(form for form in catalog.DIALECTS if form.name == tool)
    title = form.title
    for source in (tmp_path / file, tmp_path)[: 2 if form.places else 1]:
        read = load(source, Cameras)
        assert read.dialect == title
        assert not [note for note in read.notes if "checked" not in note and "left out" not in note]
        assert len(read.cameras) == 3
        for i, camera in enumerate(read.cameras):
            assert (camera.width, camera.height) == (kept.width, kept.height)
            place, directions = camera.rays()
            assert_allclose(place, kept.poses[i, :3, 3], rtol=0, atol=1e-9)
            assert_allclose(directions, kept.directions(i), rtol=0, atol=1e-9)
            assert (tmp_path / camera.picture).is_file()
        assert read.problems() == []


@pytest.mark.parametrize("tool", TOOLS)
def test_a_tool_is_known_from_a_subfolder(
    tool: str, made: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, _ = written(tool, tmp_path, made)
    monkeypatch.chdir((tmp_path / file).parent)
    read = load(Path(file).name, Cameras)
    assert len(read.cameras) == 3


def test_a_project_of_metashape_is_its_chunk(made: Rig, tmp_path: Path) -> None:
    write_pictures(tmp_path, made)
    one = load(tmp_path / camera_tools.write_metashape_project(tmp_path, made), Cameras)
    other = load(tmp_path / camera_tools.write_metashape(tmp_path, made), Cameras)
    assert one.source == "scan.files/0/chunk.zip:doc.xml"
    for first, second in zip(one.cameras, other.cameras, strict=True):
        assert first.rays()[1].tobytes() == second.rays()[1].tobytes()


def test_transforms_come_before_the_files_of_tools(made: Rig, tmp_path: Path) -> None:
    written("metashape", tmp_path, made)
    assert load(tmp_path, Cameras).dialect == "Metashape"
    write_nerfstudio(tmp_path, made)
    assert load(tmp_path, Cameras).source == "transforms.json"


def test_the_first_tool_of_the_catalog_is_read(made: Rig, tmp_path: Path) -> None:
    for tool in ("openmvg", "opensfm", "gaussian_cameras", "metashape"):
        written(tool, tmp_path, made)
        title = next(form.title for form in catalog.DIALECTS if form.name == tool)
        assert load(tmp_path, Cameras).dialect == title


def test_poses_alone_are_named_and_refused(made: Rig, tmp_path: Path) -> None:
    file, _ = written("open3d", tmp_path, made)
    (tmp_path / "intrinsics.txt").unlink()
    with pytest.raises(InvalidFile, match=r"is a trajectory \(Open3D, 3 poses\) without focal lengths"):
        load(tmp_path / file, Cameras)
    with pytest.raises(InvalidFile, match="is a folder of unknown kind"):
        load(tmp_path, Cameras)


@pytest.mark.parametrize("tool", ["metashape", "opensfm", "meshroom", "openmvg", "gaussian_cameras", "nvm", "bundler"])
def test_names_do_not_lead_out_of_the_folder(tool: str, made: Rig, tmp_path: Path) -> None:
    home = tmp_path / "capture"
    file, _ = written(tool, home, made)
    write_pictures(tmp_path / "outside", made)
    for path in (home / "images").iterdir():
        path.unlink()
    for path in home.iterdir():
        if path.is_file():
            path.write_bytes(path.read_bytes().replace(b"images/r_0", b"r_0").replace(b"r_0", b"../outside/r_0"))
    names = [camera.picture for camera in load(home / file, Cameras).cameras]
    assert names[0] in ("r_0", "r_0.png")
    assert not any(".." in name for name in names)


def test_a_lens_with_skew_bends_as_its_matrix_says(made: Rig, tmp_path: Path) -> None:
    """u = cx + fx x + b2 y, by hand: at y = 0.1 a skew of 2 px moves a point by 0.2 px."""
    file = camera_tools.write_metashape(tmp_path, made, calibration="<b2>2</b2>")
    camera = load(tmp_path / file, Cameras).cameras[0]
    assert camera.lens is not None
    assert camera.lens.skew == pytest.approx(2 / made.fx)
    (look,), _ = camera.lens.looks(np.array([[(1.75 + 0.2) / made.fx, 0.1]]))
    assert look[:2] / look[2] == pytest.approx([1.75 / made.fx, 0.1], abs=1e-12)


def test_scale_of_a_capture_does_not_scale_its_axes(made: Rig, tmp_path: Path) -> None:
    """Metashape's scale is applied to positions alone, so that no pose has axes of length 2.5."""
    file, _ = written("metashape", tmp_path, made)
    assert load(tmp_path / file, Cameras).pose_notes == ()


def test_views_keep_what_is_held_out(made: Rig, tmp_path: Path) -> None:
    read = replace(load(write_nerfstudio(tmp_path, made), Cameras), held_out=(0, 2))
    assert read.take([2, 1]).held_out == (0,)
