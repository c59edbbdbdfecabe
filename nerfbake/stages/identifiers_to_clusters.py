"""Identifiers -> clusters of colours that look alike from everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake import progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.cluster import colours, lloyd, planes
from nerfbake.stages.specular_to_identifiers import Identifiers

MAX_CLUSTERS = 1 << 16
COARSE_ROUNDS = 30  # of Lloyd's iteration on the means of small cells of colours, which cost next to nothing
# Few clusters end in many different places: the best of so many starts has 0.5 % less inertia at 64 (0.1 % at 256).
STARTS, FEW = 4, 128
ROUNDS = 12  # on the colours themselves; 20 lower the inertia by another 0.3 %
_CELL_BITS = 5  # of colour: the cells that prune the assignment
_GROUPS_PER_CLUSTER = 8
PLANE_ROUNDS = 6
FLATNESS = 1 / 255**2  # pull on a plane's slopes, for what the members do not settle: one step of a byte
_CANDIDATES = 16  # planes that a cell's colours may go to


@dataclass(frozen=True, eq=False)
class Clusters:
    """K clusters of u colours, in the order of their members' codes.

    labels   (u,) int32
    members  (K,) int64: the colour that stands for each cluster, an index into the identifiers
    """

    labels: npt.NDArray[np.int32]
    members: npt.NDArray[np.int64]

    @property
    def K(self) -> int:
        return len(self.members)


def cluster_identifiers(identifiers: Identifiers, *, clusters: int = 64, seed: int = 0) -> Clusters:
    """Weighted k-means of the identifiers, each centre then snapped to the member with the closest identifier.

    Labels go by the snapped colours. Centres that nobody is near, or that snap to one colour, are dropped, so that
    there may be fewer clusters than asked for. The same seed gives the same clusters, whatever the number of threads.
    Raises InvalidScene for more clusters than colours.
    Source: docs/formats/atlas.md, "The thesis' method", with Lloyd's iteration made exact and fast.

    Greedy k-means++ on the means of cells of 5-bit colour starts the rounds. `nerfbake bench atlas` compares
    it with scikit-learn's KMeans.

    >>> import numpy as np
    >>> from nerfbake import cluster_identifiers, identify_colours, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> identifiers = identify_colours(field, directions=np.eye(3))
    >>> cluster_identifiers(identifiers, clusters=4).K
    4
    """
    points, weight = identifiers.points, identifiers.counts
    if not 1 <= clusters <= min(len(points), MAX_CLUSTERS):
        allowed = f"1 to {min(len(points), MAX_CLUSTERS):,}; the texture has {len(points):,} colours"
        raise InvalidScene(Problem("clusters", f"is {clusters:,}", allowed))
    cells = lloyd.bound_cells(points, _cells(identifiers.codes, _CELL_BITS))
    centres = _coarse_centres(identifiers, clusters, np.random.default_rng(seed))
    for _ in progress.each(range(ROUNDS)):
        centres = lloyd.move(points, weight, lloyd.nearest_centres(points, cells, centres)[0], centres)
    members = lloyd.nearest_members(*lloyd.nearest_centres(points, cells, centres), clusters)
    members = np.unique(members[members >= 0])
    labels = lloyd.nearest_centres(points, cells, points[members])[0]
    # Every member is its own nearest, so that no label is without colours; equal points share the first's.
    held = np.unique(labels)
    return Clusters(np.searchsorted(held, labels).astype(np.int32), members[held])


def cluster_planes(identifiers: Identifiers, *, clusters: int = 64, seed: int = 0) -> Clusters:
    """Clusters of colours whose identifiers follow the feature in a plane; `members` are cluster_identifiers()'s.

    From cluster_identifiers()'s on, each round fits a plane to every cluster and gives each colour to the plane that
    comes closest: after 6 rounds affine maps have half the squared error of those of plain clusters.

    >>> import numpy as np
    >>> from nerfbake import cluster_planes, identify_colours, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> identifiers = identify_colours(field, directions=np.eye(3))
    >>> cluster_planes(identifiers, clusters=2).K
    2
    """
    found = cluster_identifiers(identifiers, clusters=clusters, seed=seed)
    points, features = identifiers.points, identifiers.features.astype(np.float32)
    cells = lloyd.bound_cells(points, _cells(identifiers.codes, _CELL_BITS))
    candidates = planes.nearest_clusters(cells, points[found.members], _CANDIDATES)
    labels = found.labels
    for _ in range(PLANE_ROUNDS):
        fitted = planes.fit(points, features, identifiers.counts, labels, found.K, FLATNESS)
        labels = planes.nearest_planes(points, features, cells, candidates, fitted)
    held, compact = np.unique(labels, return_inverse=True)
    return Clusters(compact.astype(np.int32), found.members[held])


def _coarse_centres(identifiers: Identifiers, clusters: int, random: np.random.Generator) -> npt.NDArray[np.float32]:
    """k-means of the means of cells of colours, the largest cells that are several times as many as the clusters."""
    for bits in range(_CELL_BITS, 9):
        start = _cells(identifiers.codes, bits)
        if len(start) > _GROUPS_PER_CLUSTER * clusters or bits == 8:
            break
    groups = lloyd.group(identifiers.points, identifiers.counts, start)
    cells = lloyd.bound_cells(groups.mean, _cells(identifiers.codes[start[:-1]], bits - 1))

    def end_of_a_start() -> npt.NDArray[np.float32]:
        centres = lloyd.seed(groups.mean, groups.weight, clusters, random)
        for _ in range(COARSE_ROUNDS):
            centres = lloyd.move(
                groups.mean, groups.weight, lloyd.nearest_centres(groups.mean, cells, centres)[0], centres
            )
        return centres

    def inertia(centres: npt.NDArray[np.float32]) -> float:
        return float((lloyd.nearest_centres(groups.mean, cells, centres)[1] * groups.weight).sum())

    if clusters > FEW:
        return end_of_a_start()
    return min((end_of_a_start() for _ in range(STARTS)), key=inertia)


def _cells(codes: npt.NDArray[np.uint32], bits: int) -> npt.NDArray[np.int64]:
    """Where each cell of colours of so many bits a channel starts, and the end."""
    return colours.runs(codes >> np.uint32(3 * (8 - bits)))
