from __future__ import annotations

import numpy as np
import pytest

from nerfbake.errors import NerfbakeError
from tests.support.meshes import TEXELS, mesh


def test_a_mesh_that_cannot_be_is_refused() -> None:
    for wrong, named in (
        ({"texture": TEXELS}, "has no texture coordinates"),
        ({"texture": TEXELS[..., :2], "uvs": np.zeros((3, 2))}, "has shape"),
        ({"colours": np.full((3, 3), 2, np.float32)}, "mesh colours"),
        ({"uvs": np.full((3, 2), np.inf)}, "mesh uvs"),
        ({"uvs": np.zeros((2, 2))}, "mesh uvs have shape"),
    ):
        with pytest.raises(NerfbakeError, match=named):
            mesh(np.eye(3), [[0, 1, 2]], **wrong)
    with pytest.raises(NerfbakeError, match="has no faces"):
        mesh(np.eye(3), np.empty((0, 3)))
