"""The set is what its generator writes, nerfbake finds its numbers in it, and `nerfbake check` its faults."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from nerfbake import Camera, Splats, load, render_splats
from nerfbake.io import check
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.splat_axes import to_axes
from tests.conformance.gaussian_splatting.expected import numbers_of, picture_of
from tests.conformance.gaussian_splatting.files import HOME, all_files
from tests.conformance.gaussian_splatting.invalid import invalid
from tests.conformance.gaussian_splatting.scenes import EDGE, FOV, POSE, Scene, scenes
from tests.support.splat_pictures import covariances

SCENES, INVALID = list(scenes()), list(invalid())
each_scene = pytest.mark.parametrize("scene", SCENES, ids=[scene.name for scene in SCENES])


def found_in(path: Path) -> Splats:
    """The splats in glTF's axes."""
    return to_axes(load(path, Splats), "LUF")


def test_the_files_are_what_the_generator_writes() -> None:
    expected = all_files()
    assert {str(path.relative_to(HOME)) for path in HOME.rglob("*") if path.is_file()} == {*expected, "README.md"}
    for name, data in expected.items():
        if not name.endswith(".png"):
            assert (HOME / name).read_bytes() == data, name
        else:  # zlib decides their bytes
            pictures = [np.asarray(PIL.Image.open(io.BytesIO(each))) for each in (data, (HOME / name).read_bytes())]
            assert np.array_equal(pictures[0], pictures[1]), name
    assert sum(path.stat().st_size for path in HOME.rglob("*") if path.is_file()) < 1_000_000


@each_scene
def test_the_numbers_are_found(scene: Scene) -> None:
    told = json.loads((HOME / f"valid/{scene.name}.json").read_text())
    found = found_in(HOME / f"valid/{scene.name}.glb")
    assert found.n == len(told["splats"])
    close: dict[str, Any] = {"rtol": 2e-6, "atol": 2e-6}
    np.testing.assert_allclose(found.means + found.origin, [each["mean"] for each in told["splats"]], **close)
    shapes = covariances(found)[:, *np.triu_indices(3)]
    np.testing.assert_allclose(shapes, [each["covariance"] for each in told["splats"]], **close)
    np.testing.assert_allclose(found.opacity, [each["opacity"] for each in told["splats"]], **close)
    basis = sh_basis(np.array(told["directions"]), found.B)
    colours = np.maximum(np.einsum("db,nbc->ndc", basis, found.sh.astype(np.float64)) + 0.5, 0)
    np.testing.assert_allclose(colours, [each["colors"] for each in told["splats"]], **close)
    assert any("linear" in note for note in found.notes) == told["colorSpace"].startswith("lin")


@each_scene
def test_the_picture_is_drawn(scene: Scene) -> None:
    camera = Camera(EDGE, EDGE, EDGE / 2 / math.tan(FOV / 2), POSE)
    drawn = render_splats(found_in(HOME / f"valid/{scene.name}.glb"), camera, background=(0, 0, 0)).colour
    expected = picture_of(scene)
    if scene.linear:  # before sRGB
        expected = np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4)
    assert psnr(drawn.astype(np.float64), expected) > 50  # nerfbake sorts by depth, and the extension by distance
    assert expected.max() > 0.3


@each_scene
def test_a_valid_file_has_no_findings(scene: Scene) -> None:
    assert check(HOME / f"valid/{scene.name}.glb") == []


@pytest.mark.parametrize("case", INVALID, ids=[case.name for case in INVALID])
def test_an_invalid_file_has_its_finding_alone(case: tuple[str, ...]) -> None:
    told = json.loads((HOME / "invalid/findings.json").read_text())[f"{case[0]}.glb"]
    (problem,) = check(HOME / f"invalid/{case[0]}.glb")
    assert {"place": problem.place, "found": problem.found, "allowed": problem.allowed} == told


def test_every_rule_has_a_file() -> None:
    """A coefficient, a degree, an integer type and each property of a node are told apart by the numbers."""
    seen = set()
    for scene in SCENES:
        if scene.name not in ("defaults", "required", "fallback"):  # whose JSON differs, and not their numbers
            seen.add(json.dumps({key: value for key, value in numbers_of(scene).items() if key != "about"}))
    same = {"interleaved", "scale_unsigned_byte", "scale_unsigned_short", "position_short", "rotations"}
    assert len(seen) >= len(SCENES) - 3 - len(same)
