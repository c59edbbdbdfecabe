"""Where `bench access` reads: points in voxels, the same for every row, from a fixed seed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.bench.access.rays import STEP
from nerfbake.scene.camera import Camera, look_at
from nerfbake.scene.vdb_topology import VdbTopology

Places = npt.NDArray[np.float32]
DIAGONAL = 800  # samples, as in PlenVDB's table 3; again and again, since they take microseconds
EDGE, FOCAL, DISTANCE = 400, 550.0, 1.3  # a camera's pixels and focal length; its distance in diagonals of the box


def kinds_of_points(size: tuple[int, int, int], topology: VdbTopology, count: int) -> dict[str, Places]:
    """About `count` points of each kind, (n, 3) float32; the topology has at least one voxel.

    diagonal   from corner to corner of the grid
    random     anywhere in it
    rays       one after the other along the rays of a camera, row by row, inside the box of the active voxels
    surface    in active voxels drawn at random, anywhere in each
    """
    random = np.random.default_rng(0)
    top = np.array(size) - 1
    coords = topology.coords
    diagonal = np.linspace(0, 1, DIAGONAL)[:, None] * top
    voxels = coords[random.integers(0, len(coords), count)]
    kinds = {
        "diagonal": np.tile(diagonal, (max(1, count // DIAGONAL), 1)),
        "random": random.uniform(0, 1, (count, 3)) * top,
        "rays": _along_rays(topology, count),
        "surface": voxels + random.uniform(-0.5, 0.5, (count, 3)),
    }
    return {kind: points.astype(np.float32) for kind, points in kinds.items()}


def _along_rays(topology: VdbTopology, count: int) -> npt.NDArray[np.float64]:
    box = topology.box
    assert box is not None
    low, high = box[0] - 0.5, box[1] + 0.5
    diagonal = float(np.linalg.norm(high - low))
    pose = look_at((low + high) / 2, np.radians(-50), np.radians(28), DISTANCE * diagonal)
    place, directions = Camera(EDGE, EDGE, FOCAL, pose).rays()
    # The axes are a camera's to choose: none of these directions is parallel to a face.
    to = (np.stack([low, high])[:, None] - place) / directions  # (2, rays, 3)
    begin, end = to.min(axis=0).max(axis=1), to.max(axis=0).min(axis=1)
    steps = np.maximum(((end - begin) / STEP).astype(np.int64), 0)
    # From the middle row on, as many rays as it takes.
    first = EDGE * (EDGE // 2) * (count < steps.sum() // 2)
    steps = steps[first:]
    rays = first + np.repeat(np.arange(len(steps)), steps)[:count]
    n = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps))[:count]
    return np.asarray(place + directions[rays] * (begin[rays] + n * STEP)[:, None])
