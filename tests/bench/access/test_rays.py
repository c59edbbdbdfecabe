from __future__ import annotations

import numpy as np
import pytest

from nerfbake.bench.access.rays import Counts, count_samples
from nerfbake.errors import InvalidScene
from nerfbake.scene.camera import Camera
from nerfbake.scene.vdb import VdbTree
from tests.support.vdb_readers import tree, volume


def test_samples_along_a_ray_by_hand() -> None:
    # A ray down the x axis through eight voxels of a leaf, of edge 0.25, seen through a single pixel.
    coords = np.array([[x, 0, 0] for x in (0, 1, 2, 3, 6, 7)])
    grid = tree(coords)
    values = np.full((6, 1), 2.0, np.float32)
    values[4] = 0
    grid = VdbTree("density", grid.topology, values, grid.background)
    scene = volume(grid)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]], axis=1)
    pose[:3, 3] = scene.transform[:, 3] + scene.transform[:, :3] @ [20.2, 0, 0]
    camera = Camera(1, 1, 1.0, pose)
    assert count_samples(scene, grid, camera) == Counts(possible=16, valid=12, needed=10)
    opaque = VdbTree("density", grid.topology, np.full((6, 1), 1e3, np.float32), grid.background)
    assert count_samples(scene, opaque, camera) == Counts(16, 12, 1)
    far = pose.copy()
    far[0, 3] = 1e15  # which is four times as many voxels
    with pytest.raises(InvalidScene, match=r"a camera is too far away; allowed: coordinates up to 1e\+15 voxels"):
        count_samples(scene, grid, Camera(1, 1, 1.0, far))
    empty = tree(np.zeros((0, 3)))
    assert count_samples(volume(empty), empty, camera) == Counts(0, 0, 0)
