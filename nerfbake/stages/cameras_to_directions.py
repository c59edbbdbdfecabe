"""Cameras and the mesh they look at -> how much each direction counts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.products import product
from nerfbake.scene.mesh import Mesh

FLOOR = 0.1  # of the mean weight: what no camera saw must not be left to chance
_SAMPLE = 4096  # surface points


def weigh_directions(
    mesh: Mesh, cameras: npt.NDArray[np.float64], directions: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(N,) how often the surface is looked at along each of N unit directions, 1 on average.

    cameras (c, 3) stand in the mesh's own world. Every face counts by its area, for every camera that its front turns
    to; what stands between them does not. A line of sight counts for the direction closest to it. Raises InvalidScene
    if no camera sees any front. Source: the future work of the K-means thesis (docs/sources.md).

    >>> import numpy as np
    >>> from nerfbake import Mesh, weigh_directions
    >>> triangle = Mesh(np.eye(3, dtype=np.float32), None, np.array([[0, 1, 2]], np.uint32))
    >>> weights = weigh_directions(triangle, np.array([[9.0, 9.0, 9.0]]), np.concatenate([np.eye(3), -np.eye(3)]))
    >>> weights.shape, round(float(weights.mean()), 6)
    ((6,), 1.0)
    """
    a, b, c = (mesh.positions[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    # Points at even steps along the summed area: each stands for the same share of the surface.
    steps = (np.arange(_SAMPLE) + 0.5) / _SAMPLE * area.sum()
    taken = np.minimum(np.searchsorted(np.cumsum(area), steps), len(area) - 1)
    points, normals = (a + b + c)[taken] / 3, across[taken]
    count = np.zeros(len(directions))
    for camera in cameras:
        sight = points - camera
        seen = sight[(sight * normals).sum(axis=1) < 0]
        count += np.bincount(np.argmax(product(seen, directions.T), axis=1), minlength=len(directions))
    if not count.any():
        raise InvalidScene(Problem("the cameras", "see no front of the mesh", "cameras in the mesh's own world"))
    weights = count / count.mean() + FLOOR
    return np.asarray(weights / weights.mean())
