"""Jobs with scenery: a fit of photographs alone, and what follows from its file."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import build_field, io, jobs, render_field, sample_n3tree, scatter_cameras
from nerfbake.cli.main import run
from nerfbake.errors import InvalidFile, InvalidScene, UsageError
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.views import Views
from nerfbake.stages.brick_field_to_n3tree import build_n3tree
from tests.support.brick_fields import some_shelled_field
from tests.support.rooms import write_room

SHORT = "cells=32,scale=4,epochs=2,density=0.05,prune=0.02/cells=32,scale=2,epochs=1,split=0.3"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shells") / "a.npz"
    io.save(path, build_n3tree(some_shelled_field(basis=4)))
    return path


@pytest.mark.long
def test_photographs_alone_become_a_scene(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    room = tmp_path / "room"
    write_room(room, frames=8)
    assert run(["fit", str(room), str(tmp_path / "a.npz"), "--epochs", SHORT, "--basis", "SH1", "--json"]) == 0
    written = capfd.readouterr()
    assert "has photographs without cameras, so their poses are found first" in written.err
    assert (room / "transforms.json").exists()
    tree = io.load(tmp_path / "a.npz", N3Tree)
    assert tree.shells == 6
    # 1.5 times the 64 cells of the inner cube, rounded to a whole factor of the 240x180 pixels.
    assert "fits to and measures on pictures of 120x90 pixels" in written.err
    assert tree.held_out is not None
    assert (tree.held_out.cameras.cameras[0].width, tree.held_out.cameras.cameras[0].height) == (120, 90)
    assert json.loads(written.out)["psnr"] > 15
    assert "check that the poses belong" not in written.err
    # The scenery has no place in an octree; the second fit finds the cameras that the first one wrote.
    with pytest.raises(
        UsageError, match=r"has scenery behind the object, which .*a\.svo\.pb cannot store; allowed: a Pl"
    ):
        jobs.fit_file(str(room), str(tmp_path / "a.svo.pb"), options=jobs.FitOptions(epochs=SHORT))
    assert not (tmp_path / "a.svo.pb").exists()


def test_wider_pictures_with_scenery_are_used_less_often() -> None:
    def epochs(width: int, height: int) -> list[int]:
        camera, picture = Camera(width, height, 64.0, np.eye(4), "a"), np.full((height, width, 4), 255, np.uint8)
        views = Views(Cameras((camera, camera)), (picture, picture), (1.0, 1.0, 1.0), False, scenery=True)
        return [stage.epochs for stage in jobs.FitOptions(preset="fast", resolution=64).schedule(views)]

    assert epochs(128, 96) == epochs(96, 96) == [2 * each for each in epochs(256, 96)] == [150, 100, 100, 50]


def test_a_folder_without_pictures_and_cameras_is_refused_as_before(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(InvalidFile, match="is a folder of unknown kind"):
        jobs.fit_file(str(tmp_path), str(tmp_path / "a.npz"))


@pytest.mark.usefixtures("fewer_rays")
def test_octrees_and_volumes_take_the_inner_cube(scene: Path, tmp_path: Path) -> None:
    octree = jobs.bake_octree(str(scene), str(tmp_path / "a.svo.npz"))
    assert octree.size == (64, 64, 64)
    np.testing.assert_allclose(octree.origin, [-1, -1, -1])
    volume = jobs.bake_volume(str(scene), str(tmp_path / "a.vdb"))
    assert volume.frame is not None
    assert volume.frame.size == (64, 64, 64)
    jobs.compress_file(str(scene), str(tmp_path / "a.svoq"))
    jobs.view_file(str(scene), str(tmp_path / "a.html"))
    assert all((tmp_path / name).exists() for name in ("a.svoq", "a.html"))


@pytest.mark.long
def test_poses_of_other_pictures_are_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    room = tmp_path / "room"
    write_room(room, frames=8)
    jobs.find_poses(str(room))
    cameras = io.load(room, Cameras)
    others = [cameras.cameras[(3 * i + 1) % 8] for i in range(8)]
    wrong = [
        replace(camera, name=other.name, picture=other.picture)
        for camera, other in zip(cameras.cameras, others, strict=True)
    ]
    io.save(room / "transforms.json", replace(cameras, cameras=tuple(wrong)), force=True)
    assert run(["fit", str(room), str(tmp_path / "a.npz"), "--epochs", SHORT, "--basis", "SH1"]) == 0
    told = capfd.readouterr().err
    assert "7 views are few for scenery; parts that fewer than three of them show are placed far away" in told
    assert re.search(
        r"room: neighbouring pictures agree on the depth of \d% of what looks .*; check that the pos", told
    )
    assert re.search(r"a poor fit; pictures of a single colour have \d+\.\d\d dB; check that the poses belong", told)
    assert "; an object before a dark or changing background needs --masks" in told


@pytest.fixture
def shown(tmp_path: Path) -> Path:
    """A folder with a PlenOctree, a.npz, and photographs of it before noise."""
    tree = sample_n3tree(resolution=32, basis="SH1")
    io.save(tmp_path / "a.npz", tree)
    field, random = build_field(tree), np.random.default_rng(0)
    cameras: list[Camera] = []
    (tmp_path / "photos").mkdir()
    for camera in scatter_cameras(field, frames=16, edge=48).cameras:
        image = render_field(field, camera, background=None)
        noise = random.random((48, 48, 3), dtype=np.float32)
        colour = image.colour + (1 - image.alpha[..., None]) * noise
        cameras.append(replace(camera, name=f"{len(cameras):02d}", picture=f"{len(cameras):02d}.png"))
        opaque = replace(image, colour=colour, background=(1.0, 1.0, 1.0))
        io.save(tmp_path / "photos" / cameras[-1].picture, opaque)
    io.save(tmp_path / "photos" / "transforms.json", Cameras(tuple(cameras)))
    return tmp_path


def test_photographs_with_scenery_show_the_mesh_and_the_splats_alone(shown: Path) -> None:
    field, photos, options = (
        str(shown / "a.npz"),
        str(shown / "photos"),
        jobs.MeshOptions(triangles=(1000,), texture=128),
    )
    mesh = jobs.bake_mesh(field, str(shown / "a.glb"), pictures=jobs.MeshViews(views=photos), options=options)
    assert mesh.quality.psnr > 22  # with the noise it would be below 10
    assert mesh.quality.iou > 0.9
    few = jobs.SplatsOptions(splats=1000, epochs=4)
    splats = jobs.bake_splats(field, str(shown / "a.ply"), jobs.SplatsViews(views=photos), options=few)
    assert splats.psnr > 20


def test_a_mesh_of_scenery_needs_half_as_many_pictures(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = tmp_path / "inner.npz"
    io.save(inner, io.load(scene, N3Tree).inner_cube())
    asked = []

    def refuse(*_: object, frames: int, **__: object) -> None:
        asked.append(frames)
        raise InvalidScene("enough")

    monkeypatch.setattr("nerfbake.jobs.mesh_options.render_split", refuse)
    for source, views in (scene, jobs.MeshViews()), (scene, jobs.MeshViews(frames=7)), (inner, jobs.MeshViews()):
        with pytest.raises(InvalidScene, match="enough"):
            jobs.bake_mesh(str(source), str(tmp_path / "a.glb"), pictures=views)
    assert asked == [50, 7, 100]


@pytest.mark.long
def test_a_fit_of_scenery_is_written_as_a_mesh_of_the_inner_cube(
    shown: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    options = ["--epochs", SHORT, "--basis", "SH1"]
    assert run(["fit", str(shown / "photos"), str(shown / "b.glb"), *options]) == 0
    told = capfd.readouterr().err
    assert "has scenery; " in told
    assert re.search(r"b\.glb: \d+\.\d\d dB, SSIM .*, silhouettes' IoU .* on 2 pictures with alpha", told)
