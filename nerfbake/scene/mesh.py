"""A triangle mesh with texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.topology import count_problem

UV_MARGIN = 1e-3  # how far outside the texture a coordinate may be, for a writer's rounding


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles over vertices that carry their texture coordinates, as glTF has them.

    positions  (v, 3) float32, in the field's own world
    uvs        (v, 2) float32 in 0..1, v down: (0, 0) is the upper left corner of the texture
    faces      (t, 3) uint32, counter-clockwise from outside
    """

    positions: npt.NDArray[np.float32]
    uvs: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]

    def __post_init__(self) -> None:
        v = len(self.positions)
        for name, array, shape, dtype in (
            ("positions", self.positions, (v, 3), np.float32),
            ("uvs", self.uvs, (v, 2), np.float32),
            ("faces", self.faces, (len(self.faces), 3), np.uint32),
        ):
            if array.shape != shape or array.dtype != dtype or not len(array):
                found = f"have shape {array.shape}, dtype {array.dtype}"
                raise InvalidScene(Problem(f"mesh {name}", found, f"{shape} {np.dtype(dtype).name}, at least one"))
        finite = ~np.isfinite(self.positions)
        outside = ~((self.uvs >= -UV_MARGIN) & (self.uvs <= 1 + UV_MARGIN))
        problems = count_problem("mesh positions", finite, self.positions, "a finite number")
        problems += count_problem("mesh uvs", outside, self.uvs, "0 to 1")
        problems += count_problem("mesh faces", self.faces >= v, self.faces, f"a vertex, 0 to {v - 1:,}")
        if problems:
            raise InvalidScene(problems[0])

    @property
    def normals(self) -> npt.NDArray[np.float32]:
        """(v, 3) unit, the mean of the faces around each vertex by area; zero where they cancel."""
        a, b, c = (self.positions[self.faces[:, corner]].astype(np.float64) for corner in range(3))
        across = np.cross(b - a, c - a)
        total = np.zeros(self.positions.shape)
        for axis in range(3):
            weights = np.repeat(across[:, axis], 3)
            total[:, axis] = np.bincount(self.faces.reshape(-1), weights, minlength=len(total))
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return (total / np.where(length > 0, length, 1)).astype(np.float32)
