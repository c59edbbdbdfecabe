"""Splats in USD: judged by OpenUSD, NVIDIA's validator and tinyusdz, attribute by attribute."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pxr import UsdGeom, UsdVol

from nerfbake import Splats, load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.splat import usd, usda, usdc, usdz
from nerfbake.scene.splats import UPS
from nerfbake.stages.splats_to_image import render_splats
from tests.support.splats import splats
from tests.support.usd import errors_of, facts_of, layer, opened
from tests.support.usd import in_this_process as in_this_process
from tests.support.views import sample_views

pytestmark = pytest.mark.usefixtures("in_this_process")
WRITERS = (usda, usdc, usdz)
ARRAYS = ("means", "scales", "quats", "opacity", "sh")
MAP = np.array([453000.125, 5012345.5, 120.25])
each_writer = pytest.mark.parametrize("module", WRITERS, ids=lambda module: module.__name__[-4:])


def written(module: ModuleType, scene: Splats, **options: Any) -> bytes:
    return b"".join(module.encode(scene, **options))


def read(data: bytes) -> Splats:
    return usd.decode(memoryview(data))


def assert_same(found: Splats, expected: Splats, *, turns: float = 1.2e-7) -> None:
    """Equal but for the rounding of quaternions, whose length the reader makes 1."""
    for name in ARRAYS:
        if name == "quats":
            assert np.abs(found.quats - expected.quats).max() <= turns
        else:
            assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert found.antialiased == expected.antialiased


def prim_of(stage: Any) -> Any:
    return UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/scene/splats"))


# -- what is written -------------------------------------------------------------------------------------------
@each_writer
@pytest.mark.parametrize("degree", range(4))
def test_openusd_reads_every_attribute_bit_for_bit(module: ModuleType, degree: int, tmp_path: Path) -> None:
    scene = splats(30, degree=degree)
    stage = opened(tmp_path / f"a.{module.__name__[-4:]}", written(module, scene))
    prim, turned = prim_of(stage), scene.flipped()
    for attribute, expected in (
        (prim.GetPositionsAttr(), turned.means),
        (prim.GetScalesAttr(), turned.scales),
        (prim.GetOrientationsAttr(), turned.quats[:, [1, 2, 3, 0]]),
        (prim.GetOpacitiesAttr(), turned.opacity),
        (prim.GetRadianceSphericalHarmonicsCoefficientsAttr(), turned.sh.reshape(-1, 3)),
    ):
        assert_array_equal(np.asarray(attribute.Get()), expected)
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == degree
    assert prim.GetOrientationsAttr().Get()[0].GetReal() == turned.quats[0, 0]
    assert facts_of(stage) == ("Y", 1.0, "/scene")
    assert errors_of(stage) == []
    coefficients = UsdGeom.Primvar(prim.GetRadianceSphericalHarmonicsCoefficientsAttr())
    assert (coefficients.GetElementSize(), coefficients.GetInterpolation()) == ((degree + 1) ** 2, "vertex")


def test_the_schema_knows_every_attribute_but_our_own(tmp_path: Path) -> None:
    for half in (False, True):
        scene = splats(3, antialiased=True)
        stage = opened(tmp_path / f"{half}.usdc", written(usdc, scene, half=half))
        prim = prim_of(stage).GetPrim()
        authored = [each for each in prim.GetAuthoredProperties() if each.GetName() != "nerfbake:antialiased"]
        assert [each.GetName() for each in authored if each.IsCustom()] == []
        known = prim.GetPrimDefinition()
        for each in authored:
            assert str(each.GetTypeName()) == str(known.GetAttributeDefinition(each.GetName()).GetTypeName())


@each_writer
def test_half_floats_are_the_nearest_and_positions_stay_in_float(module: ModuleType, tmp_path: Path) -> None:
    scene = splats(40, degree=3)
    data = written(module, scene, half=True)
    stage = opened(tmp_path / f"a.{module.__name__[-4:]}", data)
    prim, turned = prim_of(stage), scene.flipped()
    assert_array_equal(np.asarray(prim.GetPositionsAttr().Get()), turned.means)
    assert not prim.GetScalesAttr().HasAuthoredValue()
    assert_array_equal(np.asarray(prim.GetScaleshAttr().Get()), turned.scales.astype(np.float16))
    assert_array_equal(np.asarray(prim.GetOrientationshAttr().Get()), turned.quats[:, [1, 2, 3, 0]].astype(np.float16))
    assert_array_equal(np.asarray(prim.GetOpacitieshAttr().Get()), turned.opacity.astype(np.float16))
    assert errors_of(stage) == []
    assert_same(read(data), module.stored(scene, half=True))


def test_half_refuses_what_it_cannot_hold() -> None:
    scene = splats(3)
    scene.scales[1, 1] = 70_000
    written(usdc, scene)
    with pytest.raises(InvalidScene, match="the splats hold 70000; allowed: up to 65504 in half floats"):
        written(usdc, scene, half=True)
    scene.scales[1, 1] = np.nan
    with pytest.raises(InvalidScene, match="scales"):
        written(usdc, scene)


def test_degree_4_is_read_but_not_written() -> None:
    """NVIDIA's rule for splats allows 0 to 3."""
    with pytest.raises(InvalidScene, match="sh has degree 4; allowed: 0 to 3"):
        written(usdc, splats(3, degree=4))
    body = f"uniform int {usd.DEGREE} = 4\nfloat3[] {usd.SH} = [{', '.join(['(1, 2, 3)'] * 50)}]"
    assert read(layer(prim(body))).degree == 4


def test_the_extent_holds_three_sigma_along_each_axis(tmp_path: Path) -> None:
    turn = np.array([[1, 0, 0, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], np.float32)  # none, and x to y
    means, scales = np.array([[0, 0, 0], [10, 0, 0]], np.float32), np.array([[1, 2, 3], [1, 2, 3]], np.float32)
    scene = Splats(means, scales, turn, np.ones(2, np.float32), np.zeros((2, 1, 3), np.float32), up="z")
    stage = opened(tmp_path / "a.usdc", written(usdc, scene))
    extent = np.asarray(prim_of(stage).GetExtentAttr().Get())
    assert np.allclose(extent, [[-3, -6, -9], [16, 6, 9]], atol=1e-5)
    # A prim without extent has an empty box; with it, the box of the stage has the splats.
    cache = UsdGeom.BBoxCache(0, ["default"])
    box = cache.ComputeWorldBound(stage.GetPseudoRoot()).ComputeAlignedRange()
    assert np.allclose([*box.GetMin()], extent[0])


def test_a_package_is_one_crate_and_166_bytes() -> None:
    scene = splats(100)
    data = written(usdz, scene)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.namelist() == ["scene.usdc"]
        assert archive.read("scene.usdc") == written(usdc, scene)
    assert len(data) - len(written(usdc, scene)) < 250


def test_the_same_splats_give_the_same_bytes() -> None:
    for module in WRITERS:
        assert written(module, splats(20)) == written(module, splats(20))


# -- up --------------------------------------------------------------------------------------------------------
def test_splats_with_z_up_are_not_turned_and_others_are(tmp_path: Path) -> None:
    for up in (*UPS, None):
        scene = replace(splats(9, degree=3), up=up)
        stage = opened(tmp_path / f"{up}.usdc", written(usdc, scene))
        expected = scene if up == "z" else scene.flipped()
        assert facts_of(stage)[0] == ("Z" if up == "z" else "Y")
        assert_array_equal(np.asarray(prim_of(stage).GetPositionsAttr().Get()), expected.means)
        found = read(written(usdc, scene))
        assert_same(found, scene)
        assert found.up == ("z" if up == "z" else "-y")


def test_the_signs_of_sh_are_those_of_half_a_turn_about_x() -> None:
    signs = np.sign(replace(splats(1, degree=3), sh=np.ones((1, 16, 3), np.float32)).flipped().sh[0, :, 0])
    told = "".join("+" if sign > 0 else "-" for sign in signs)
    assert [told[:1], told[1:4], told[4:9], told[9:]] == ["+", "--+", "-++-+", "-+--+-+"]


@pytest.mark.slow
def test_pictures_of_what_is_read_are_the_same() -> None:
    scene = splats(60, degree=3)
    scene = replace(scene, scales=scene.scales * 8)
    camera = sample_views(frames=1, width=8, height=8).cameras.cameras[0]
    body = read(written(usda, scene))
    before, after = (render_splats(each, camera).colour for each in (scene, body))
    assert np.abs(before - after).max() < 1e-5
    assert before.std() > 0.02


# -- read back -------------------------------------------------------------------------------------------------
@each_writer
@pytest.mark.parametrize("degree", range(4))
def test_splats_are_read_back_as_they_were(module: ModuleType, degree: int) -> None:
    scene = splats(25, degree=degree, antialiased=degree % 2 == 0)
    found = read(written(module, scene))
    assert_same(found, scene)
    assert_same(module.stored(scene), found)
    assert found.notes == ()


def test_an_origin_is_the_translation(tmp_path: Path) -> None:
    scene = replace(splats(300, degree=1), origin=MAP)
    found = read(written(usdz, scene))
    assert np.abs(found.origin + found.means - (scene.origin + scene.means)).max() < 1e-6
    assert found.origin.any()


def test_files_are_found_by_their_content_whatever_their_names_are(tmp_path: Path) -> None:
    scene = splats(5)
    for module, name in ((usda, "a.usd"), (usdc, "b.usd"), (usdz, "c.usdz"), (usda, "d.usda")):
        (tmp_path / name).write_bytes(written(module, scene))
        assert_same(load(tmp_path / name, Splats), scene)
    save(tmp_path / "a.usdc.zst", scene)
    assert_same(load(tmp_path / "a.usdc.zst", Splats), scene)


# -- files of others -------------------------------------------------------------------------------------------
def prim(body: str) -> str:
    return f'def ParticleField3DGaussianSplat "s"\n{{\n point3f[] positions = [(0, 1, 2), (3, 4, 5)]\n{body}\n}}'


def test_defaults_are_those_of_the_schema() -> None:
    found = read(layer(prim("")))
    assert found.scales.tolist() == [[1, 1, 1]] * 2
    assert found.quats.tolist() == [[1, 0, 0, 0]] * 2
    assert found.opacity.tolist() == [1, 1]
    assert found.sh.tolist() == [[[0, 0, 0]]] * 2  # a grey of 0.5
    assert found.notes == ()


def test_longer_arrays_are_cut_and_shorter_ones_ignored_with_a_note() -> None:
    body = "float3[] scales = [(2, 2, 2), (3, 3, 3), (4, 4, 4)]\nfloat[] opacities = [0.5]\n"
    body += "uniform int radiance:sphericalHarmonicsDegree = 1\n"
    body += "float3[] radiance:sphericalHarmonicsCoefficients = [(1, 2, 3)]"
    found = read(layer(prim(body)))
    assert found.scales.tolist() == [[2, 2, 2], [3, 3, 3]]
    assert found.opacity.tolist() == [1, 1]
    assert found.degree == 0
    assert [note.split(" of ")[0] for note in found.notes] == ["opacities", "radiance:sphericalHarmonicsCoefficients"]
    assert found.notes[1].endswith("are 1, not 8; their default is used")


def test_floats_come_before_halves() -> None:
    both = "float[] opacities = [0.25, 0.5]\nhalf[] opacitiesh = [0.75, 1]"
    assert read(layer(prim(both))).opacity.tolist() == [0.25, 0.5]
    assert read(layer(prim("half[] opacitiesh = [0.75, 1]"))).opacity.tolist() == [0.75, 1]


def test_units_axes_and_transforms_are_applied() -> None:
    place = "double3 xformOp:translate = (100, 0, 0)\nfloat3 xformOp:scale = (2, 2, 2)\n"
    place += 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]'
    found = read(layer(prim(place), metres=0.01))
    assert np.allclose(found.means, [[1, -0.02, -0.04], [1.06, -0.08, -0.1]])  # y and z change their signs
    assert np.allclose(found.scales, 0.02)
    found = read(layer(prim(place), up="Z"))
    assert np.allclose(found.means, [[100, 2, 4], [106, 8, 10]])
    found = read(layer(prim(place.replace("(2, 2, 2)", "(2, 2, 3)"))))  # stretches, as in a .glb
    assert np.allclose(found.means, [[100, -2, -6], [106, -8, -15]])
    matrix = "matrix4d xformOp:transform = ((1, 0, 0, 0), (1, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))\n"
    with pytest.raises(InvalidScene, match="the transform of the splats shears"):
        read(layer(prim(matrix + 'uniform token[] xformOpOrder = ["xformOp:transform"]')))


def test_several_prims_are_joined_and_meshes_named() -> None:
    other = 'def Mesh "m"\n{\n}'
    found = read(layer(prim("") + "\n" + prim("").replace('"s"', '"t"') + "\n" + other))
    assert (found.n, found.left_out) == (4, ("meshes",))


def test_rows_that_cannot_be_drawn_are_counted_and_nonsense_is_refused() -> None:
    assert read(layer(prim("float[] opacities = [0.5, nan]"))).dropped == 1
    for body, said in (
        ("uniform int radiance:sphericalHarmonicsDegree = 5", "is 5; allowed: 0 to 4"),
        ("uniform int radiance:sphericalHarmonicsDegree = -1", "is -1; allowed: 0 to 4"),
    ):
        with pytest.raises(InvalidFile, match=said):
            read(layer(prim(body)))
    with pytest.raises(InvalidScene, match="2 rows of 2"):
        read(layer(prim("float[] opacities = [7, -1]")))
    with pytest.raises(InvalidFile, match="the stage has no splats"):
        read(layer('def ParticleField3DGaussianSplat "s"\n{\n}'))


# -- other judges ----------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def nvidia() -> Callable[[Path], list[str]]:
    """NVIDIA's validator with its rule for splats, which is off unless it is named."""
    validator: Any = import_module("usd_validation_nvidia")
    engine = validator.ValidationEngine(init_rules=True)
    (rule,) = (each for key, each in validator.RequirementsRegistry().items() if "VG.035" in str(key))
    engine.enable_requirement(rule)
    return lambda path: [each.message for each in engine.validate(str(path)).issues()]


@each_writer
@pytest.mark.parametrize("degree", range(4))
def test_nvidias_rule_for_splats_passes(
    module: ModuleType, degree: int, nvidia: Callable[[Path], list[str]], tmp_path: Path
) -> None:
    path = tmp_path / f"a.{module.__name__[-4:]}"
    path.write_bytes(written(module, splats(12, degree=degree)))
    found = nvidia(path)
    if module is usda:  # a warning about every array of some size
        found = [each for each in found if "containing ASCII" not in each]
    assert found == []


def test_nvidias_rule_finds_what_openusd_does_not(nvidia: Callable[[Path], list[str]], tmp_path: Path) -> None:
    data = layer(prim("float[] opacities = [7, -1]"))
    path = tmp_path / "a.usda"
    assert errors_of(opened(path, data)) == []
    assert nvidia(path)
    path.write_bytes(written(usda, splats(3), half=True))  # allowed by the schema
    assert any("Required attribute 'scales' is missing" in each for each in nvidia(path))


@each_writer
def test_tinyusdz_reads_the_same_numbers(module: ModuleType, tmp_path: Path) -> None:
    tinyusdz: Any = import_module("tinyusdz")
    scene = splats(6, degree=3)
    path = tmp_path / f"a.{module.__name__[-4:]}"
    path.write_bytes(written(module, scene))
    found = tinyusdz.load(str(path)).get_prim_at_path("/scene/splats")
    turned = scene.flipped()
    for name, expected in (
        ("positions", turned.means),
        ("scales", turned.scales),
        ("opacities", turned.opacity),
        ("radiance:sphericalHarmonicsCoefficients", turned.sh),
    ):
        text = re.sub(r"[^-+.0-9e]+", " ", found.get_attribute(name).value.to_string())
        assert np.allclose(np.array(text.split(), np.float64), expected.reshape(-1), rtol=1e-5, atol=1e-6), name
