from __future__ import annotations

import numpy as np
import pytest

from nerfbake import Meshes
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


def test_meshes_that_turn_or_move_keep_their_notes_and_their_place() -> None:
    origin = np.array([453000.0, 5012345.0, 120.0])
    scene = Meshes((mesh(np.eye(3), [[0, 1, 2]]),), notes=("told",), origin=origin)
    assert scene.with_up("z").notes == scene.with_up("y").notes == ("told",)
    assert scene.with_up("z").origin.tolist() == [453000.0, -120.0, 5012345.0]  # (x, y, z) becomes (x, -z, y)
    moved = scene.relative_to(origin - [0, 0, 2])
    assert moved.meshes[0].positions.tolist() == [[1, 0, 2], [0, 1, 2], [0, 0, 3]]
    assert (moved.notes, moved.origin.tolist()) == (("told",), [453000.0, 5012345.0, 118.0])


@pytest.mark.parametrize("origin", [np.zeros(2), np.zeros(3, np.float32), np.full(3, np.nan), np.full(3, 1e16)])
def test_an_origin_that_cannot_be_is_refused(origin: np.ndarray) -> None:
    with pytest.raises(NerfbakeError, match="origin"):
        Meshes((mesh(np.eye(3), [[0, 1, 2]]),), origin=origin)
