"""What a march knows of its rays is what NumPy's arrays say, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels.march.directions import rotate_and_project
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import rotate


@pytest.mark.parametrize("B", [1, 4, 9, 16, 25])
def test_rays_are_faced_as_arrays_are(B: int) -> None:
    random = np.random.default_rng(B)
    looks, turn, axes = random.normal(size=(2500, 3)), random.normal(size=(3, 3)), random.normal(size=(3, 3))
    looks /= np.sqrt((looks * looks).sum(axis=1))[:, None]
    ways, basis = rotate_and_project(looks, turn, axes, B)
    assert ways.tobytes() == rotate(looks, turn).tobytes()
    assert basis.tobytes() == sh_basis(rotate(looks, axes), B, np.float32).tobytes()
