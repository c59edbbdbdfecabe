"""Synthetic scenes as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import (
    Cameras,
    Image,
    N3Tree,
    Stage1,
    build_field,
    load,
    orbit_object,
    orbit_room,
    render_field,
    render_object,
    render_room,
    sample_n3tree,
)
from nerfbake.errors import OutputError, UsageError
from nerfbake.jobs import FitOptions, fit_file, write_sample_capture, write_sample_n3tree, write_sample_stage1

SHORT = (
    "cells=32,scale=2,epochs=8,density=0.03..0.015,colour=0.5..0.3,rays=1,split=0,prune=0.03/"
    "cells=64,scale=1,epochs=6,density=0.025..0.01,colour=0.5..0.2,rays=1,prune=0.03"
)


def test_a_tree_is_what_was_written(tmp_path: Path) -> None:
    tree = write_sample_n3tree(tmp_path / "a.npz", resolution=8, basis="SH1")
    np.testing.assert_array_equal(load(tmp_path / "a.npz", N3Tree).data, tree.data)
    with pytest.raises(OutputError, match="exists already"):
        write_sample_n3tree(tmp_path / "a.npz", resolution=7)


def test_a_stage1_folder_is_what_was_written(tmp_path: Path) -> None:
    scene = write_sample_stage1(tmp_path / "in", resolution=32)
    np.testing.assert_array_equal(load(tmp_path / "in", Stage1).fields[0].features, scene.fields[0].features)
    with pytest.raises(OutputError, match="exists already"):
        write_sample_stage1(tmp_path / "in", resolution=7)


def test_a_capture_has_the_photographs_that_its_cameras_took(tmp_path: Path) -> None:
    write_sample_capture(tmp_path, frames=3, edge=24)
    cameras = load(tmp_path, Cameras)
    assert (len(cameras.cameras), cameras.samples) == (3, 2)
    field = build_field(sample_n3tree())
    for camera in cameras.cameras:
        image = load(tmp_path / f"{camera.name}.png", Image)
        again = render_field(field, camera, background=None, samples=2)
        assert np.abs(image.alpha - again.alpha).max() <= 0.5 / 255 + 1e-6
        assert 0.05 < float(image.alpha.mean()) < 0.9
    with pytest.raises(OutputError, match="exists already"):
        write_sample_capture(tmp_path, frames=3, edge=24)
    with pytest.raises(UsageError, match="a folder"):
        write_sample_capture("-")


def test_photographs_of_the_room_are_opaque_and_show_it_through_their_cameras(tmp_path: Path) -> None:
    write_sample_capture(tmp_path / "a", frames=3, edge=24, room=True, seed=4)
    cameras = load(tmp_path / "a", Cameras)
    assert cameras.samples == 2
    for camera, made in zip(cameras.cameras, orbit_room(frames=3, width=24, height=24).cameras, strict=True):
        np.testing.assert_allclose(camera.pose, made.pose, atol=1e-12)
        image = load(tmp_path / "a" / f"{camera.name}.png", Image)
        assert image.background is not None  # no alpha
        truth = render_room(camera, seed=4, samples=2).colour
        assert np.abs(image.colour - truth).max() <= 0.5 / 255 + 1e-6
    write_sample_capture(tmp_path / "b", frames=3, edge=24, room=True, seed=4)
    first, again = ({path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in "ab")
    assert len(first) == 4
    assert first == again


@pytest.mark.parametrize("name", ["struts", "bricks"])
def test_photographs_of_an_object_are_transparent_and_show_it_through_their_cameras(name: str, tmp_path: Path) -> None:
    write_sample_capture(tmp_path, frames=2, edge=24, object=name, seed=4)
    cameras = load(tmp_path, Cameras)
    assert cameras.samples == 2
    for camera, made in zip(cameras.cameras, orbit_object(frames=2, edge=24, seed=4).cameras, strict=True):
        np.testing.assert_allclose(camera.pose, made.pose, atol=1e-12)
        image = load(tmp_path / f"{camera.name}.png", Image)
        assert np.abs(image.alpha - render_object(name, camera, samples=2).alpha).max() <= 0.5 / 255 + 1e-6


def test_an_object_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`object` is 'crane'; allowed: shapes, struts, bricks"):
        write_sample_capture(tmp_path / "a", object="crane")


@pytest.mark.long  # test_scenery.py of stages fits a smaller room
def test_the_room_is_fitted_with_everything_around_the_table(tmp_path: Path) -> None:
    room, scene = tmp_path / "room", tmp_path / "room.npz"
    cameras = write_sample_capture(room, frames=32, edge=64, room=True).cameras
    fitted = fit_file(str(room), str(scene), options=FitOptions(epochs=SHORT, basis="SH1"))
    assert len(fitted.views) == 4
    assert min(view.psnr for view in fitted.views) > 22
    field = build_field(load(scene, N3Tree))
    for camera in cameras[::8]:
        true, found = render_room(camera).depth, render_field(field, camera).depth
        assert np.median(np.abs(found / true - 1)) < 0.2
        assert (found > 0.5 * true).mean() > 0.9  # no fog is in front of the camera
