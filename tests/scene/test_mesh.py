from __future__ import annotations

import numpy as np
import pytest

from nerfbake import Meshes
from nerfbake.errors import NerfbakeError
from nerfbake.scene.mesh import rounding_notes
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


def test_positions_that_float32_moves_visibly_are_told() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert rounding_notes(corners + 1000.0) == ()
    assert rounding_notes((corners + 1e6).astype(np.float32).astype(np.float64)) == ()  # exact, wherever they are
    (told,) = rounding_notes(corners * 0.4 + 1e6)
    assert told == "its coordinates are far from the origin, and rounded by up to 0.025; its extent is 0.4"
    for places in (np.empty((0, 3)), np.full((3, 3), np.nan), np.full((3, 3), 0.1)):
        assert rounding_notes(places) == ()
    scene = Meshes((mesh(np.eye(3), [[0, 1, 2]]),), notes=("told",))
    assert scene.with_up("z").notes == scene.with_up("y").notes == ("told",)
