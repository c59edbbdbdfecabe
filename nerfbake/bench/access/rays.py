"""Count the samples of camera rays in a VDB for the two passes of PlenVDB's ray marching (its table 1).

    possible   samples at steps of half a voxel from the camera, inside the box around the active voxels
    valid      possible samples in an active voxel: the first pass, which reads only masks, passes them to the second
    needed     valid samples that change the picture: opacity of at least ALPHA, before the transmittance is below CUT

Source: PlenVDB (Yan et al., 2023), 4.3. The density is that of the nearest voxel, without interpolation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.bench.measure import Progress
from nerfbake.bench.report import Table
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.accessor import Tables, child_of, leaf_at, voxel_of
from nerfbake.scene.camera import Camera
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.volume import Volume

STEP = 0.5  # voxels; a ray takes no more steps than its way through the box is long, however far away it starts
ALPHA, CUT = 1e-4, 1e-4
FARTHEST = 1e15  # voxels: limit of camera coordinates, so that steps are exact whole numbers
CHUNK = 1 << 12  # rays that a core marches in one go
RAYS_EDGE = 400  # pixels of the cameras whose rays are counted in a report
_COLUMNS = ["R", "cameras", "", "possible M", "valid M", "valid %", "needed M", "needed %"]
RAY_NOTES = [
    "Two passes, as in PlenVDB's table 1: possible: samples at steps of half a voxel in the box of the active voxels; "
    "valid: possible samples in an active voxel; needed: valid samples with an opacity of at least 1e-4, before the "
    "transmittance falls below 1e-4. Nearest voxel.",
]


class Counts(NamedTuple):
    """The numbers of samples of one camera."""

    possible: int
    valid: int
    needed: int


def count_samples(volume: Volume, tree: VdbTree, camera: Camera) -> Counts:
    """Count samples along a ray through each pixel of the camera; `tree` is a density of the volume, 1/world unit.

    Raises InvalidScene for a camera that is too far away, in voxels.
    """
    if (box := tree.topology.box) is None:
        return Counts(0, 0, 0)
    place, directions = camera.rays()
    start = volume.index_of(place)
    along = directions @ np.linalg.inv(volume.transform[:, :3]).T  # voxels a world unit
    length = np.linalg.norm(along, axis=1, keepdims=True)
    forward, step = along / length * STEP, STEP / length[:, 0]
    if not (np.abs(start) <= FARTHEST).all():
        raise InvalidScene(Problem("a camera", "is too far away", f"coordinates up to {FARTHEST:g} voxels"))
    low, high = (box[k].astype(np.float64) + side for k, side in ((0, -0.5), (1, 0.5)))
    found = np.zeros((len(directions), 3), np.int64)
    table = np.concatenate([tree.background[None], tree.values], dtype=np.float32)

    def work(begin: int, end: int) -> None:
        own = slice(begin, end)
        march(tree.topology.tables, table, start, forward[own], step[own], low, high, found[own])

    over_chunks(work, len(directions), CHUNK)
    return Counts(*found.sum(axis=0).tolist())


def ray_rows(R: int, volume: Volume, cameras: Sequence[Camera], progress: Progress) -> list[list[Any]]:
    """Return table rows with the samples in the volume's first grid, a density: total, and mean of a camera."""
    if not cameras:
        return []
    tree = volume.grids[0]
    assert isinstance(tree, VdbTree)
    counts = []
    for camera in cameras:
        with progress(f"R = {R}: rays of {camera.name}"):
            counts.append(count_samples(volume, tree, camera.resized(RAYS_EDGE, RAYS_EDGE)))
    total = Counts(*map(sum, zip(*counts, strict=True)))
    rows: list[list[Any]] = []
    for what, parts in (("total", 1), ("mean of a camera", len(cameras))):
        millions = [count / parts / 1e6 for count in total]
        valid, needed = (100 * count / max(total.possible, 1) for count in total[1:])
        rows.append([R, len(cameras), what, millions[0], millions[1], valid, millions[2], needed])
    return rows


def ray_table(rows: list[list[Any]], what: str = "") -> Table:
    """Return the rows of ray_rows() as a table; what: text appended to its title."""
    return Table(f"Samples along rays, {RAYS_EDGE}x{RAYS_EDGE}{what}", _COLUMNS, rows)


@compiled()
def march(
    tables: Tables,
    table: Singles,
    start: npt.NDArray[np.float64],
    forward: npt.NDArray[np.float64],
    step: npt.NDArray[np.float64],
    low: npt.NDArray[np.float64],
    high: npt.NDArray[np.float64],
    found: npt.NDArray[np.int64],
) -> None:
    """Write the counts of each ray into found (n, 3).

    start (3,), the steps forward (n, 3) and the box's corners low and high (3,) are in voxels. step (n,) is the length
    of a step in world units.
    """
    for ray in range(len(forward)):
        begin, end = 0.0, np.inf
        for axis in range(3):
            if forward[ray, axis] != 0:
                a = (low[axis] - start[axis]) / forward[ray, axis]
                b = (high[axis] - start[axis]) / forward[ray, axis]
                begin, end = max(begin, min(a, b)), min(end, max(a, b))
            elif start[axis] < low[axis] or start[axis] >= high[axis]:
                end = -1.0
        through = 1.0
        leaf, c0, c1, c2 = np.uint64(0), 1 << 40, 1 << 40, 1 << 40
        for n in range(int(np.ceil(begin)), int(np.ceil(end)) if end > begin else 0):
            x = int(np.floor(start[0] + n * forward[ray, 0] + 0.5))
            y = int(np.floor(start[1] + n * forward[ray, 1] + 0.5))
            z = int(np.floor(start[2] + n * forward[ray, 2] + 0.5))
            found[ray, 0] += 1
            if (x >> 3 ^ c0) | (y >> 3 ^ c1) | (z >> 3 ^ c2):
                leaf, c0, c1, c2 = leaf_at(tables, x, y, z), x >> 3, y >> 3, z >> 3
            row = child_of(tables.leaf, voxel_of(leaf, x, y, z), np.uint64(0))
            if row == 0:
                continue
            found[ray, 1] += 1
            alpha = -np.expm1(-table[row, 0] * step[ray])
            if through >= CUT and alpha >= ALPHA:
                found[ray, 2] += 1
                through *= 1 - alpha
