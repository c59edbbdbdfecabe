"""What a march knows of its rays is what NumPy's arrays say, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels.march.directions import look_and_project, rotate_and_project
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import rotate
from nerfbake.scene.camera import Camera, look_at


@pytest.mark.parametrize("B", [1, 4, 9, 16, 25])
def test_rays_are_faced_as_arrays_are(B: int) -> None:
    random = np.random.default_rng(B)
    looks, turn, axes = random.normal(size=(2500, 3)), random.normal(size=(3, 3)), random.normal(size=(3, 3))
    looks /= np.sqrt((looks * looks).sum(axis=1))[:, None]
    ways, basis = rotate_and_project(looks, turn, axes, B)
    assert ways.tobytes() == rotate(looks, turn).tobytes()
    assert basis.tobytes() == sh_basis(rotate(looks, axes), B, np.float32).tobytes()


@pytest.mark.parametrize("B", [1, 9, 25])
def test_rays_of_a_pinhole_camera_are_those_of_the_camera(B: int) -> None:
    random = np.random.default_rng(B)
    turn, axes = random.normal(size=(3, 3)), random.normal(size=(3, 3))
    pose = look_at(random.normal(size=3), 0.7, -0.3, 4.0)
    camera = Camera(67, 41, (53.1, 57.9), pose, "odd", centre=(30.2, 22.7))
    slopes = camera.slopes()
    assert slopes is not None
    ways, basis = look_and_project(*slopes, camera.pose[:3, :3], turn, axes, B)
    expected_ways, expected_basis = rotate_and_project(camera.rays()[1], turn, axes, B)
    assert ways.tobytes() == expected_ways.tobytes()
    assert basis.tobytes() == expected_basis.tobytes()
