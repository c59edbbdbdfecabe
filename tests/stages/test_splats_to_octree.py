"""Splats as an octree: one splat by its formulas, and pictures of the octree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Camera, Splats, build_field, build_octree_from_splats, render_field
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import look_at
from nerfbake.stages import splats_to_octree
from nerfbake.stages.splat_box import cut_splats, finest_voxels, inner_box
from tests.support.scenes import assert_same_octree
from tests.support.splats import ball_of_splats, splats


def ball(opacity: float, sh: np.ndarray, radius: float = 0.3) -> Splats:
    turn = np.array([[1, 0, 0, 0]], np.float32)
    scales = np.full((1, 3), radius, np.float32)
    return Splats(np.zeros((1, 3), np.float32), scales, turn, np.full(1, opacity, np.float32), sh.astype(np.float32))


def seen(scene: Splats, turn: float) -> np.ndarray:
    """Red, green, blue and alpha of the ray through the origin, from a direction in the plane z = 0."""
    field = build_field(build_octree_from_splats(scene, resolution=48))
    camera = Camera(3, 3, 300.0, look_at(np.zeros(3), turn, 0.2, 5.0))
    image = render_field(field, camera, background=None)
    return np.append(image.colour[1, 1] / image.alpha[1, 1], image.alpha[1, 1])


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9])
def test_a_ball_is_as_opaque_as_its_splat(opacity: float) -> None:
    assert_allclose(seen(ball(opacity, np.zeros((1, 1, 3))), 0.3)[3], opacity, atol=0.01)


def test_an_opaque_ball_is_as_opaque_as_in_pictures_of_splats() -> None:
    assert_allclose(seen(ball(1, np.zeros((1, 1, 3))), 0.3)[3], 0.99, atol=0.002)


def test_a_pixel_makes_splats_wider_but_not_thinner() -> None:
    scene = ball(0.5, np.zeros((1, 1, 3)), radius=0.1)
    box = np.array([[-1.0] * 3, [1.0] * 3])
    own, wider = (build_octree_from_splats(scene, resolution=32, box=box, pixel=pixel) for pixel in (0.0, 0.5))
    depths = [
        octree.sample([[x, 1 / 32, 1 / 32] for x in (np.arange(32) - 15.5) / 16])[:, -1] for octree in (own, wider)
    ]
    assert np.count_nonzero(depths[1]) > 2 * np.count_nonzero(depths[0])
    assert_allclose(depths[1].sum(), depths[0].sum(), rtol=0.2)  # the voxel blurs the smaller one sideways
    assert depths[1].sum() > depths[0].sum()
    same = build_octree_from_splats(replace(scene, antialiased=True), resolution=32, box=box, pixel=0.5)
    assert_same_octree(same, own)


@pytest.mark.parametrize("turn", [0.0, 1.0, 4.0])
def test_a_colour_depends_on_the_direction(turn: float) -> None:
    random = np.random.default_rng(3)
    sh = random.uniform(-0.25, 0.25, (1, 9, 3))
    away = look_at(np.zeros(3), turn, 0.2, 5.0)[:3, 3]
    basis = sh_basis(-away[None] / np.linalg.norm(away, axis=0), 9)[0]
    colour = np.maximum(0, 0.5 + (basis[:, None] * sh[0]).sum(axis=0))
    assert_allclose(seen(ball(0.9, sh), turn)[:3], colour, atol=0.02)


def test_the_voxels_are_cubes_along_the_longest_edge() -> None:
    scene = splats(200)
    box = np.array([[-1.0, -0.5, -0.3], [1.0, 0.5, 0.31]])
    octree = build_octree_from_splats(scene, resolution=40, box=box)
    assert octree.size == (40, 20, 13)
    assert_allclose(octree.voxel_size, 0.05)
    assert_allclose(octree.origin, box[0])
    assert octree.data_format == "SH9"
    octree.require_usable()


def test_the_bytes_depend_on_neither_threads_nor_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = splats(300, degree=1)
    whole = build_octree_from_splats(scene, resolution=40)
    monkeypatch.setattr(splats_to_octree, "_PAIRS", 1)
    monkeypatch.setattr(splats_to_octree, "_CHUNK", 3)
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    assert_same_octree(build_octree_from_splats(scene, resolution=40), whole)


def test_thin_splats_and_thin_voxels_are_left_out() -> None:
    scene = splats(50, degree=0)
    scene.opacity[:25] = 0.2
    box = inner_box(scene)
    dense = build_octree_from_splats(scene, resolution=32, box=box, opacity_min=0.3)
    kept = replace(scene, **{name: getattr(scene, name)[scene.opacity >= 0.3] for name in ARRAYS})
    assert_same_octree(dense, build_octree_from_splats(kept, resolution=32, box=box))
    filled = dense.sigma[dense.childless]
    cut = build_octree_from_splats(scene, resolution=32, box=box, opacity_min=0.3, sigma_min=float(np.median(filled)))
    assert cut.sigma[cut.childless].min() >= np.median(filled)


ARRAYS = ("means", "scales", "quats", "opacity", "sh")


def test_a_lower_degree_and_half_precision() -> None:
    octree = build_octree_from_splats(splats(50), resolution=16, basis="SH4", dtype="float16", layout="compact")
    assert (octree.data_format, str(octree.node_data.dtype), octree.layout) == ("SH4", "float16", "compact")


def test_single_splats_far_away_do_not_widen_the_box() -> None:
    scene = splats(400, degree=0)
    usual = inner_box(scene)
    assert cut_splats(scene, usual).splats.n == 400
    scene.means[7], scene.means[9, 1] = 1000, -77
    scene.scales[11] = 80
    box = inner_box(scene)
    [told] = cut_splats(scene, box).notes
    assert told.startswith("leaves out 2 splats of 400 outside the box -")
    assert (np.abs(box - usual) < 0.4).all()
    octree = build_octree_from_splats(scene, resolution=16)
    assert_allclose(octree.origin, box[0])


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"resolution": 0}, "resolution is 0; allowed: 1 to 4096"),
        ({"resolution": 5000}, "resolution is 5000; allowed: 1 to 4096"),
        ({"basis": "SG3"}, "basis is SG3; allowed: SH1"),
        ({"basis": "SH2"}, "data_format is 'SH2'"),
        ({"opacity_min": 1.0}, "the splats have opacities up to 0.9"),
        ({"box": [[5, 5, 5], [6, 6, 6]]}, "the splats fill no voxel"),
        ({"box": [0, 0, 0, 1, 1]}, "box is 0, 0, 0, 1, 1; allowed: x0, y0"),
        ({"sigma_min": 1e9}, "the splats fill no voxel"),
    ],
)
def test_bad_options_are_refused(options: dict[str, object], problem: str) -> None:
    with pytest.raises(InvalidScene) as error:
        build_octree_from_splats(splats(20), **({"resolution": 8} | options))  # type: ignore[arg-type]
    assert problem in str(error.value)


def test_a_point_without_a_size_is_refused() -> None:
    with pytest.raises(InvalidScene, match="are one point of size 0"):
        build_octree_from_splats(ball(0.5, np.zeros((1, 1, 3)), radius=0.0))


def test_a_large_grid_is_refused_before_it_is_filled() -> None:
    with memory_limit(1 << 20), pytest.raises(MemoryLimit):
        build_octree_from_splats(splats(20), resolution=4096)


def test_voxels_are_half_as_wide_as_small_splats() -> None:
    scene, box = ball_of_splats(), np.array([[0.0, 0, 0], [3, 6, 1]])
    scene.scales[:] = (0.5, 0.25, 1)
    assert finest_voxels(scene, box, most=256) == 48
    assert finest_voxels(scene, box, most=20) == 20
    scene.scales[:20] = 1e-4  # as many as every twentieth are not counted
    assert finest_voxels(scene, box, most=256) == 48
    scene.scales[20] = 1e-4
    assert finest_voxels(scene, box, most=256) == 256
    scene.scales[:] = 0
    assert finest_voxels(scene, box, most=256) == 256
    scene.scales[:] = 1e9
    assert finest_voxels(scene, box, most=256) == 1
