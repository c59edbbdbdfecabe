"""Cameras in USD, judged by OpenUSD's own camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import UsdGeom

from nerfbake import load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.camera import usd, usda, usdc, usdz
from nerfbake.formats.splat.usd import splat_stage
from nerfbake.formats.wire.usd.text import encode_text
from nerfbake.jobs import convert_cameras, convert_file
from nerfbake.scene.camera import Camera, Cameras, look_at
from nerfbake.scene.lens import Lens
from nerfbake.scene.splats import Splats
from tests.support.splats import splats
from tests.support.usd import errors_of, facts_of, layer, opened
from tests.support.usd import in_this_process as in_this_process

pytestmark = pytest.mark.usefixtures("in_this_process")
PLAIN = Camera(40, 30, 50.0, look_at(np.zeros(3), 0.5, 0.4, 3.0), "r_0")
ODD = Camera(64, 48, (70.5, 60.25), look_at(np.ones(3), -2.0, 0.1, 2.0), "größe", (30.0, 26.5), picture="a/größe.png")
CAMERAS = Cameras((PLAIN, ODD))


def written(cameras: Cameras, up: str = "z") -> bytes:
    return b"".join(usdc.encode(cameras, up=up))  # type: ignore[arg-type]


def test_openusd_sees_the_same_rays(tmp_path: Path) -> None:
    stage = opened(tmp_path / "a.usdc", written(CAMERAS))
    assert facts_of(stage) == ("Z", 1.0, "/scene")
    assert errors_of(stage) == []
    for camera, name in ((PLAIN, "r_0"), (ODD, "größe")):
        found = UsdGeom.Camera(stage.GetPrimAtPath(f"/scene/{name}")).GetCamera(0)
        frustum = found.frustum
        eye, directions = camera.rays()
        assert np.allclose([*frustum.GetPosition()], eye)
        for x, y in ((0, 0), (camera.width - 1, 2), (7, camera.height - 1)):
            place = (2 * (x + 0.5) / camera.width - 1, 1 - 2 * (y + 0.5) / camera.height)
            ray = frustum.ComputePickRay(place)
            assert np.allclose([*ray.direction], directions[y * camera.width + x], atol=1e-6)
        assert (found.clippingRange.min, found.clippingRange.max) == (pytest.approx(0.01), 10_000)


def test_lengths_are_tenths_of_a_world_unit(tmp_path: Path) -> None:
    stage = opened(tmp_path / "a.usdc", written(Cameras((PLAIN,))))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/r_0"))
    wide, focal = camera.GetHorizontalApertureAttr().Get(), camera.GetFocalLengthAttr().Get()
    assert (wide, focal) == (pytest.approx(0.36), pytest.approx(50 * 0.36 / 40))  # 36 mm in metres


@pytest.mark.parametrize("module", [usda, usdc, usdz], ids=lambda module: module.__name__[-4:])
def test_cameras_are_read_back(module: object, tmp_path: Path) -> None:
    data = b"".join(module.encode(CAMERAS))  # type: ignore[attr-defined]
    found = usd.decode(memoryview(data))
    for camera, expected in zip(found.cameras, CAMERAS.cameras, strict=True):
        assert (camera.width, camera.height) == (expected.width, expected.height)
        assert np.allclose(
            [camera.fx, camera.fy, camera.cx, camera.cy], [expected.fx, expected.fy, expected.cx, expected.cy]
        )
        assert np.array_equal(camera.pose, expected.pose)
        assert camera.name == expected.name
    assert found.cameras[1].picture == "a/größe.png"
    assert (found.dialect, found.notes) == ("USD", ())


def test_a_stage_is_a_source_of_cameras_and_a_capture_becomes_one(tmp_path: Path) -> None:
    save(tmp_path / "transforms.json", CAMERAS)
    convert_file(tmp_path / "transforms.json", tmp_path / "a.usda")
    convert_cameras(tmp_path / "a.usda", tmp_path / "b.json")
    assert load(tmp_path / "b.json", Cameras).names == CAMERAS.names


def test_distortion_is_refused() -> None:
    bent = replace(PLAIN, lens=Lens("polynomial", (0.1,)))
    with pytest.raises(InvalidScene, match=r"camera r_0 has lens distortion; allowed: a pinhole, or transforms.json"):
        written(Cameras((bent,)))


def test_cameras_and_splats_of_one_stage_are_in_one_world(tmp_path: Path) -> None:
    scene = splats(3)
    text = b"".join(encode_text(splat_stage(scene))).decode()
    place = 'double3 xformOp:translate = (1, 2, 3)\nuniform token[] xformOpOrder = ["xformOp:translate"]\n'
    text = text.removesuffix("}\n") + f'def Camera "c"\n{{\n{place}}}\n}}\n'
    path = tmp_path / "both.usda"
    path.write_text(text)
    assert np.array_equal(load(path, Splats).means, scene.means)
    found = load(path, Cameras)
    assert found.eyes.tolist() == [[1, -2, -3]]
    assert np.array_equal(found.cameras[0].pose[:3, :3], np.diag([1, -1, -1]))
    assert "1 of 1 cameras tell no size" in found.notes[0]
    assert load(path).__class__ is Splats


def test_cameras_of_others() -> None:
    (camera,) = usd.decode(memoryview(layer('def Camera "c"\n{\n}', metres=0.01))).cameras
    assert (camera.width, camera.height) == (800, 584)
    assert np.allclose(camera.fx, 800 * 50 / 20.955)
    for body, said in (
        ('token projection = "orthographic"', "has the projection orthographic"),
        ("float focalLength = 0", "has a focal length of 0"),
        ("float focalLength = nan", "focalLength is nan"),
        ("float verticalAperture = -1", "apertures of 20.955 and -1"),
    ):
        with pytest.raises(InvalidFile, match=said):
            usd.decode(memoryview(layer(f'def Camera "c"\n{{\n{body}\n}}')))
    with pytest.raises(InvalidFile, match="the stage has no cameras"):
        usd.decode(memoryview(layer("")))
