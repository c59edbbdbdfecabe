"""Variants of a scene: what is made and measured, and what is refused before any work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd

from nerfbake import sample_n3tree, save
from nerfbake.errors import UsageError
from nerfbake.jobs import (
    MeshOptions,
    MeshViews,
    SplatsOptions,
    SplatsViews,
    VariantOptions,
    bake_variants,
    compare_files,
)
from nerfbake.jobs.comparisons import ComparedViews
from tests.jobs.listener import Listener
from tests.support.usd import errors_of

SMALL = VariantOptions(
    splats=SplatsOptions(splats=100, epochs=1),
    splats_views=SplatsViews(frames=4, edge=32),
    mesh=MeshOptions(triangles=(100,), texture=32),
    mesh_views=MeshViews(frames=4, edge=32),
)


@pytest.mark.long
@pytest.mark.usefixtures("folder")
def test_a_scene_becomes_three_variants_with_their_losses(listener: Listener) -> None:
    save("a.npz", sample_n3tree(resolution=8), force=True)
    made = bake_variants("a.npz", "a.usda", ["mesh", "splats", "volume"], options=SMALL, steps=listener)
    assert {path.name for path in Path().glob("a.*")} >= {"a.usda", "a.png", "a.vdb"}
    stage = Usd.Stage.Open("a.usda")
    prim = stage.GetDefaultPrim()
    boxes = []
    for variant in made.variants:
        assert prim.GetVariantSet("representation").SetVariantSelection(variant.name)
        assert errors_of(stage) == []
        assert prim.GetCustomDataByKey("nerfbake:psnr") == variant.psnr
        assert f"a.usda: {variant.name}: {variant.psnr:.2f} dB against a.npz" in listener.said
        boxes.append([each.GetAttribute("extent").Get() for each in stage.Traverse() if each.HasAttribute("extent")])
    (mesh,), _, (volume,) = boxes
    assert np.abs(np.asarray(mesh) - np.asarray(volume)).max() < 0.5  # two voxels
    seen = compare_files("a.npz", "a.vdb", seen=ComparedViews(size=(32, 32)))
    assert seen.found.means["a_b"]["psnr"] < made.variants[2].psnr  # a.vdb has y up, and the first has z up


@pytest.mark.usefixtures("folder")
def test_what_cannot_be_written_is_refused_first(listener: Listener) -> None:
    for out, names, told in (
        (
            "a.usdz",
            ["splats", "volume"],
            r"a \.usdz cannot contain a volume; allowed: `variants` without it, or \.usda",
        ),
        (
            "a.usda",
            ["splats", "cameras"],
            "`variants` are 'splats,cameras'; allowed: some of splats, mesh, volume, each",
        ),
        ("a.usda", ["mesh", "mesh"], "`variants` are 'mesh,mesh'"),
        ("a.usda", [], "`variants` are ''"),
        ("a.usdc", ["mesh"], "has no file extension for variants of a scene"),
        ("a.ply", ["mesh"], r"extension for variants of a scene \(.*\); allowed: .usda, .usdz"),
    ):
        with pytest.raises(UsageError, match=told):
            bake_variants("a.npz", out, names, steps=listener)
    with pytest.raises(UsageError, match="`variants` read IN several times; allowed: a file"):
        bake_variants("-", "a.usda", ["mesh"])
    assert listener.phases == []
