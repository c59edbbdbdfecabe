from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from nerfbake import (
    Cameras,
    Image,
    build_field,
    build_octree,
    build_vdb,
    cut_octree,
    load,
    render_field,
)
from nerfbake.scene.n3tree import N3Tree
from tests.conftest import DATA

CHAIR = DATA / "plenoctree" / "chair"


def psnr(a: npt.NDArray[np.uint8], b: npt.NDArray[np.uint8]) -> float:
    return float(-10 * np.log10(((a.astype(float) - b) ** 2).mean() / 255**2))


def over_white(path: Path) -> npt.NDArray[np.uint8]:
    image = load(path, Image)
    colour = image.colour + (1 - image.alpha[..., None])
    return np.asarray(np.rint(255 * np.clip(colour, 0, 1)), np.uint8)


@pytest.mark.data
@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "expected", "reference"),
    [
        ("chair_sh9", 34.58, "chair_sh9"),
        ("chair_sh9_128", 30.23, "chair_sh9_128"),
        ("chair_sh9_128_legacy", 30.23, "chair_sh9_128"),
        ("chair_sh9_128_fragmented", 30.23, None),
        ("chair_sh9_128_quant", 30.27, None),
        ("chair_sh9_128_quant_retain1", 30.28, None),
    ],
)
def test_the_chair_looks_as_its_description_says(name: str, expected: float, reference: str | None) -> None:
    field = build_field(load(CHAIR / f"{name}.npz", N3Tree))
    against_truth = []
    for camera in load(CHAIR / "views" / "transforms.json", Cameras).cameras:
        pixels = render_field(field, camera).pixels
        against_truth.append(psnr(pixels, over_white(CHAIR / "views" / f"{camera.name}.png")))
        if reference:
            assert psnr(pixels, over_white(CHAIR / f"render_{reference}" / f"{camera.name}.png")) > 70
    assert np.mean(against_truth) == pytest.approx(expected, abs=0.02)


@pytest.mark.data
@pytest.mark.long
@pytest.mark.parametrize(("name", "expected"), [("chair_sh9", 34.938), ("chair_sh9_128", 30.48)])
def test_held_out_views(name: str, expected: float) -> None:
    field, folder = build_field(load(CHAIR / f"{name}.npz", N3Tree)), DATA / "nerf_synthetic" / "chair"
    found = []
    for camera in load(folder / "transforms_test.json", Cameras).cameras:
        truth = load(folder / "test" / f"{camera.name}.png", Image)
        seen = render_field(field, camera.resized(400, 400))
        white = truth.colour + (1 - truth.alpha[..., None])
        found.append(-10 * np.log10(((seen.colour.astype(float) - white) ** 2).mean()))
    assert len(found) == 25
    assert np.mean(found) == pytest.approx(expected, abs=0.02)


@pytest.mark.data
def test_the_octree_at_the_trees_resolution_gives_the_same_picture() -> None:
    tree = load(CHAIR / "chair_sh9_128.npz", N3Tree)
    camera = load(CHAIR / "views" / "transforms.json", Cameras).cameras[0]
    octree = build_octree(tree)
    image = render_field(build_field(tree), camera)
    assert_allclose(image.colour, render_field(build_field(octree), camera).colour, atol=1e-4)
    index = build_vdb(octree, grids=("index",))
    assert_allclose(image.colour, render_field(build_field(index), camera).colour, atol=1e-4)
    coarse = render_field(build_field(cut_octree(octree, level=6)), camera)
    assert 20 < psnr(image.pixels, coarse.pixels) < 40
