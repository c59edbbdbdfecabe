"""Median depths, against closed forms and the reference renderer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import Camera, RadianceField, build_field, orbit_cameras, render_field, sample_n3tree
from nerfbake.kernels.march.median import march_medians
from tests.support.meshes import straight_down
from tests.support.scenes import n3tree


def medians(field: RadianceField, camera: Camera) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    depth = np.empty((camera.height, camera.width), np.float32)
    alpha = np.empty_like(depth)
    optics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose = np.ascontiguousarray(camera.pose[:3])
    march_medians(field.cells, field.densities, field.box, field.place, pose, optics, depth, alpha)
    return depth, alpha


def test_a_slab_by_hand() -> None:
    # The unit cube is full: from 2 above its floor, a ray straight down loses half of its light after ln 2 / 8.
    field = build_field(n3tree(data=np.full((1, 2, 2, 2, 4), 8, np.float32), data_format="RGBA", dtype=np.float32))
    field_low, field_high = field.world(field.box)
    camera = straight_down(3, 3, 100.0, float(field_high[2]) + 1)
    camera.pose[:2, 3] = (field_low + field_high)[:2] / 2 + 0.01
    depth, alpha = medians(field, camera)
    height = field_high[2] - field_low[2]
    np.testing.assert_allclose(depth[1, 1], 1 + np.log(2) / 8, rtol=1e-5)
    np.testing.assert_allclose(alpha[1, 1], 1 - np.exp(-8 * height), rtol=1e-4)


def test_alpha_is_the_renderers_and_half_of_the_light_is_left_at_the_median() -> None:
    field = build_field(sample_n3tree(resolution=32))
    for camera in orbit_cameras(field, frames=2, width=48, height=40).cameras:
        depth, alpha = medians(field, camera)
        np.testing.assert_allclose(alpha, render_field(field, camera).alpha, atol=2e-3)
        seen = np.isfinite(depth)
        np.testing.assert_array_equal(seen, alpha >= 0.5)
        stop = np.where(seen, depth, np.inf).astype(np.float64)
        np.testing.assert_allclose(render_field(field, camera, stop=stop).alpha[seen], 0.5, atol=1e-3)


def test_a_camera_inside_of_the_field_and_one_that_looks_away() -> None:
    field = build_field(sample_n3tree(resolution=16))
    camera = orbit_cameras(field, width=16, height=16).cameras[0]
    away = Camera(16, 16, camera.focal, camera.pose @ np.diag([1.0, 1, -1, 1]) @ np.diag([-1.0, 1, 1, 1]))
    depth, alpha = medians(field, away)
    assert np.isinf(depth).all()
    assert not alpha.any()
    inside = camera.pose.copy()
    inside[:3, 3] = field.world(field.box.mean(axis=0))
    depth, _ = medians(field, Camera(16, 16, 8.0, inside))
    assert (depth >= 0).all()
