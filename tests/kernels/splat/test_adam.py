"""Gradients of splats: finite differences of the float64 reference, and their independence of threads."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Splats
from nerfbake.kernels import parallel
from nerfbake.kernels.splat.adam import SH, Entries, _gradient, _sum_entries, exp_of_step
from nerfbake.kernels.splat.backward import SUMS, TargetPicture, blend_back, entries_by_row
from nerfbake.kernels.splat.blend import TileLists
from nerfbake.kernels.splat.project import SplatArrays, project
from nerfbake.kernels.splat.tiles import bent_tiles, count_entries, even_tiles, fill_entries
from nerfbake.scene.camera import look_at
from nerfbake.scene.lens import Lens
from nerfbake.stages._eye import eye_of
from tests.support.splat_pictures import reference_picture
from tests.support.splats import splats

BACKGROUND, ALPHA = (0.2, 0.5, 0.8), 0.3


def gradient(scene: Splats, camera: Camera, pixels: np.ndarray, *, partial: bool = False) -> tuple[np.ndarray, float]:
    """(n, 11 + 3 B), and the sum of the squared differences."""
    eye, places = eye_of(camera)
    arrays = SplatArrays(scene.means, scene.scales, scene.quats, scene.opacity, scene.sh)
    rows, order = project(arrays, eye, scene.antialiased)
    tiles = bent_tiles(places) if len(places) else even_tiles(camera.width, camera.height)
    counts = np.zeros(tiles.rows * tiles.columns, np.int64)
    count_entries(rows, tiles, counts)
    starts = np.cumsum(counts) - counts
    ends, entries = starts.copy(), np.empty(counts.sum(), np.int32)
    fill_entries(rows, tiles, 0, tiles.rows, ends, entries)
    sums, errors = np.empty((len(entries), SUMS), np.float32), np.zeros(len(counts))
    target = TargetPicture(pixels, np.array(BACKGROUND, np.float32), ALPHA, partial)
    blend_back(rows, TileLists(0, len(counts), starts, ends, entries), tiles.columns, places, target, sums, errors)
    found = Entries(sums, *entries_by_row(entries, len(rows)))
    out = np.zeros((len(scene.means), SH + 3 * scene.B), np.float32)
    total, basis = np.zeros(SUMS), np.zeros(scene.B)
    for row, i in enumerate(order):
        if _sum_entries(found, row, total):
            _gradient(arrays, eye, scene.antialiased, rows, row, i, total, basis, out[i])
    return out, float(errors.sum())


def parameters(scene: Splats) -> list[np.ndarray]:
    """In the order of a gradient's columns, with logarithms of scales and logits of opacities, in float64."""
    means, scales, quats, opacity, sh = (
        each.astype(np.float64) for each in (scene.means, scene.scales, scene.quats, scene.opacity, scene.sh)
    )
    return [means, np.log(scales), quats, np.log(opacity / (1 - opacity))[:, None], sh.reshape(len(sh), -1)]


def loss(scene: Splats, values: list[np.ndarray], camera: Camera, pixels: np.ndarray, places: Any) -> float:
    means, scales, quats, logits, sh = values
    changed: Any = SimpleNamespace(
        means=means,
        scales=np.exp(scales),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacity=1 / (1 + np.exp(-logits[:, 0])),
        sh=sh.reshape(scene.sh.shape),
        B=scene.B,
        antialiased=scene.antialiased,
    )
    colour, alpha, _ = reference_picture(changed, camera, BACKGROUND, places)
    truth = pixels / 255
    return float(((colour - truth[..., :3]) ** 2).sum() + ALPHA * ((alpha - truth[..., 3]) ** 2).sum()) / 2


@pytest.mark.parametrize(
    ("degree", "antialiased", "lens"),
    [(0, False, None), (0, True, None), (1, True, Lens("polynomial", (-0.1,)))],
)
def test_the_gradient_is_that_of_the_reference(degree: int, antialiased: bool, lens: Lens | None) -> None:
    # At degree 0 the colour does not depend on the direction, which the gradient of the mean holds constant.
    scene = splats(40, degree=degree, seed=1, antialiased=antialiased)
    scene = replace(scene, scales=scene.scales * 8, sh=scene.sh * np.float32(0.3))
    camera = Camera(40, 30, 30.0, look_at(np.zeros(3), 0.3, 0.3, 5.0), lens=lens)
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 4)).astype(np.uint8)
    found, _ = gradient(scene, camera, pixels)
    places, plane = None, camera.plane()
    if lens and plane is not None:
        places = plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    values = parameters(scene)
    for i in np.argsort(-np.abs(found).sum(axis=1))[:3]:
        column = 0
        for number, array in enumerate(values):
            wanted = np.zeros(array.shape[1])
            for k in range(array.shape[1]):
                ends = []
                for change in (1e-5, -1e-5):
                    changed = [each.copy() for each in values]
                    changed[number][i, k] += change
                    ends.append(loss(scene, changed, camera, pixels, places))
                wanted[k] = (ends[0] - ends[1]) / 2e-5
            some = found[i, column : column + array.shape[1]]
            if number or not degree:
                assert_allclose(some, wanted, atol=2e-5 * np.abs(wanted).max())
            column += array.shape[1]


def test_ignored_pixels_have_no_effect() -> None:
    scene = splats(40, degree=0, seed=1)
    camera = Camera(40, 30, 30.0, look_at(np.zeros(3), 0.3, 0.3, 5.0))
    pixels = np.full((30, 40, 4), 255, np.uint8)
    pixels[:, 20:] = 7
    other = pixels.copy()
    other[:, 20:, :3] = 200
    (one, error), (two, same) = (gradient(scene, camera, each, partial=True) for each in (pixels, other))
    assert_array_equal(one, two)
    assert error == same > 0
    assert (gradient(scene, camera, other)[0] != one).any()


def test_threads_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = splats(2000, degree=1, seed=4)
    camera = Camera(70, 60, 60.0, look_at(np.zeros(3), 0.3, 0.3, 5.0))
    pixels = np.random.default_rng(0).integers(0, 256, (60, 70, 4)).astype(np.uint8)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(parallel, "cores", lambda threads=threads: threads)
        found.append(gradient(scene, camera, pixels)[0])
    assert_array_equal(found[0], found[1])
    assert np.abs(found[0]).max() > 0


def test_the_exponential_of_a_step() -> None:
    for x in np.linspace(-1, 1, 41).tolist():
        assert exp_of_step(x) == pytest.approx(np.exp(x), rel=1e-4)
