"""Variants of a scene in one stage: OpenUSD selects each, and finds what the formats of each write alone."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

from nerfbake import Meshes, SceneVariant, SceneVariants, Splats, build_octree, build_vdb, load, save
from nerfbake.errors import InvalidScene, UsageError
from nerfbake.formats.variants import usda, usdz
from tests.support.meshes import assert_same_mesh, painted
from tests.support.scenes import n3tree
from tests.support.splats import splats
from tests.support.usd import errors_of, facts_of
from tests.support.usd import in_this_process as in_this_process

pytestmark = pytest.mark.usefixtures("in_this_process")
KINDS = {"splats": "ParticleField3DGaussianSplat", "mesh": "Mesh", "volume": "Volume"}


@pytest.fixture(scope="module")
def parts() -> dict[str, SceneVariant]:
    volume = build_vdb(build_octree(n3tree(data_format="SH4")), grids=("density", "Cd"), up="y")
    standing = replace(splats(20, degree=1), up="z")
    return {
        "splats": SceneVariant("splats", standing, 35.25),
        "mesh": SceneVariant("mesh", painted(), 30.5),
        "volume": SceneVariant("volume", volume, 33.0),
    }


def scene_of(parts: dict[str, SceneVariant], *names: str) -> SceneVariants:
    return SceneVariants(tuple(parts[name] for name in names))


def selected(stage: Any, name: str) -> Any:
    """The default prim with this variant."""
    prim = stage.GetDefaultPrim()
    assert prim.GetVariantSet("representation").SetVariantSelection(name)
    return prim


@pytest.mark.parametrize(
    ("ending", "names"), [("usda", ("mesh", "volume", "splats")), ("usdz", ("splats", "mesh"))], ids=["usda", "usdz"]
)
def test_openusd_selects_each_variant(
    ending: str, names: tuple[str, ...], parts: dict[str, SceneVariant], tmp_path: Path
) -> None:
    save(tmp_path / f"a b.{ending}", scene_of(parts, *names))
    stage = Usd.Stage.Open(str(tmp_path / f"a b.{ending}"))
    assert facts_of(stage) == ("Y", 1.0, "/scene")
    chosen = stage.GetDefaultPrim().GetVariantSet("representation")
    assert {*chosen.GetVariantNames()} == {*names}
    assert chosen.GetVariantSelection() == names[0]
    for name in names:
        prim = selected(stage, name)
        assert errors_of(stage) == []
        shown = {each.GetTypeName() for each in stage.Traverse()}
        assert shown & {*KINDS.values()} == {KINDS[name]}
        part = parts[name]
        assert prim.GetCustomDataByKey("nerfbake:psnr") == part.psnr
        assert prim.GetCustomDataByKey("nerfbake:content") == str(part.scene)
    if "mesh" in names:
        selected(stage, "mesh")
        material = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/scene/mesh_2")).ComputeBoundMaterial()[0]
        assert material.GetPath() == "/scene/materials/material_2"
        texture = stage.GetPrimAtPath("/scene/materials/material_2/texture").GetAttribute("inputs:file").Get()
        assert texture.resolvedPath


def test_all_variants_stand_in_the_same_place(parts: dict[str, SceneVariant], tmp_path: Path) -> None:
    """A splat and a corner of the mesh at the same point of a world with z up, which is y up in the stage."""
    (mesh,) = painted().meshes[:1]
    corner = mesh.positions[0]
    lone = replace(splats(1, degree=0), means=corner[None], up="z")
    both = SceneVariants((SceneVariant("splats", lone, 30.0), parts["mesh"]))
    save(tmp_path / "a.usda", both)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    selected(stage, "splats")
    centre = np.asarray(stage.GetPrimAtPath("/scene/splats").GetAttribute("positions").Get())[0]
    selected(stage, "mesh")
    points = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh_0")).GetPointsAttr().Get())
    assert np.allclose(points[0], centre, atol=1e-6)
    assert np.allclose(centre, [corner[0], corner[2], -corner[1]], atol=1e-6)


def test_nerfbake_reads_the_variant_that_is_selected(parts: dict[str, SceneVariant], tmp_path: Path) -> None:
    for ending in ("usda", "usdz"):
        save(tmp_path / f"s.{ending}", scene_of(parts, "splats", "mesh"))
        found = load(tmp_path / f"s.{ending}", Splats)
        expected = parts["splats"].scene
        assert isinstance(expected, Splats)
        assert np.allclose(found.means, expected.with_up("z").means, atol=1e-6)
        save(tmp_path / f"m.{ending}", scene_of(parts, "mesh", "splats"))
        (first, *_) = load(tmp_path / f"m.{ending}", Meshes).meshes
        assert_same_mesh(first, painted().meshes[0], atol=1e-6)


def test_a_package_has_text_first_and_no_volume(parts: dict[str, SceneVariant]) -> None:
    with zipfile.ZipFile(io.BytesIO(b"".join(usdz.encode(scene_of(parts, "splats", "mesh"))))) as archive:
        assert archive.namelist() == ["scene.usda", "splats.usdc", "mesh.usdc", "texture_2.png"]
    with pytest.raises(InvalidScene, match=r"the volume cannot be in a \.usdz; allowed: \.usda"):
        b"".join(usdz.encode(scene_of(parts, "volume")))
    for name in ("volume", "mesh"):
        with pytest.raises(InvalidScene, match="a file on the disk"):
            b"".join(usda.encode(scene_of(parts, name)))


def test_a_scene_has_each_representation_once(parts: dict[str, SceneVariant], tmp_path: Path) -> None:
    with pytest.raises(InvalidScene, match="the variants are mesh, mesh; allowed: one or more, each once"):
        scene_of(parts, "mesh", "mesh")
    with pytest.raises(InvalidScene, match="splats is Meshes; allowed: Splats"):
        SceneVariants((SceneVariant("splats", painted(), 1.0),))
    with pytest.raises(UsageError, match="has no file extension for variants of a scene"):
        save(tmp_path / "a.usdc", scene_of(parts, "mesh"))
