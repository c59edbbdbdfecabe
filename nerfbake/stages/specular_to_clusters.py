"""Specular field -> clusters of feature colours for which the MLP returns similar outputs in all directions.

An identifier is a point that describes the MLP's outputs for a feature colour in all directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.cluster import lloyd, planes
from nerfbake.kernels.cluster.colours import Codes, codes_of, colours_of, runs
from nerfbake.kernels.maths.linear import principal_axes, product
from nerfbake.kernels.surface import mlp
from nerfbake.scene.stage1 import SpecularField

MAX_CLUSTERS = 1 << 16
COARSE_ROUNDS = 30  # rounds of Lloyd's iteration on the means of small cells of colours, which take almost no time
# With up to FEW clusters the result depends on the start. The best of STARTS starts has 0.5 % less inertia at 64
# clusters (0.1 % at 256).
STARTS, FEW = 4, 128
ROUNDS = 12  # rounds on the colours themselves; 20 reduce the inertia by another 0.3 %
# Bits per channel of the colour cells that prune the assignment. 3 bits of 8 channels make as many cells, about 30,000,
# of a real texture as 5 bits of 3 channels.
_CELL_BITS, _CELL_BITS_OF_MANY = 5, 3
_GROUPS_PER_CLUSTER = 8
PLANE_ROUNDS = 6
FLATNESS = 1 / 255**2  # regularisation of slopes that the members do not determine: one step of a byte
_CANDIDATES = 16  # planes that the colours of a cell are compared with


@dataclass(frozen=True, eq=False)
class Clusters:
    """K clusters of u colours, in the order of their members' codes.

    labels   (u,) int32: the cluster of each colour
    members  (K,) int64: the colour that represents each cluster, an index into the identifiers
    """

    labels: npt.NDArray[np.int32]
    members: npt.NDArray[np.int64]

    @property
    def K(self) -> int:
        return len(self.members)


def cluster_identifiers(identifiers: Identifiers, *, clusters: int = 64, seed: int = 0) -> Clusters:
    """Cluster the identifiers by weighted k-means, then snap each centre to the member with the closest identifier.

    Each colour gets the label of the nearest snapped centre. Centres without members are dropped, and centres that
    snap to the same colour are merged, so there may be fewer clusters than requested. The same seed gives the same
    clusters for any number of threads. Raises InvalidScene for more clusters than colours.

    The initial centres come from greedy k-means++ on the means of cells of 5-bit colour. `nerfbake bench atlas`
    compares the result with scikit-learn's KMeans. Source: docs/formats/atlas.md, "The thesis' method", with an exact
    and fast version of Lloyd's iteration.

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
    cells = lloyd.bound_cells(points, _cells(identifiers, identifiers.cell_bits))
    centres = _coarse_centres(identifiers, clusters, np.random.default_rng(seed))
    for _ in progress.each(range(ROUNDS)):
        centres = lloyd.move(points, weight, lloyd.nearest_centres(points, cells, centres)[0], centres)
    members = lloyd.nearest_members(*lloyd.nearest_centres(points, cells, centres), clusters)
    members = np.unique(members[members >= 0])
    labels = lloyd.nearest_centres(points, cells, points[members])[0]
    # Each member is nearest to itself, so every label has colours, except that equal points all get the first label.
    held = np.unique(labels)
    return Clusters(np.searchsorted(held, labels).astype(np.int32), members[held])


def cluster_planes(identifiers: Identifiers, *, clusters: int = 64, seed: int = 0) -> Clusters:
    """Cluster colours whose identifiers are an affine function (a plane) of the feature.

    Starts from cluster_identifiers(), whose `members` are kept. Each of 6 rounds fits a plane to every cluster, and
    assigns each colour to the closest plane. After these, affine maps have half the squared error that they have with
    plain clusters.

    >>> import numpy as np
    >>> from nerfbake import cluster_planes, identify_colours, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> identifiers = identify_colours(field, directions=np.eye(3))
    >>> cluster_planes(identifiers, clusters=2).K
    2
    """
    found = cluster_identifiers(identifiers, clusters=clusters, seed=seed)
    points, features = identifiers.points, identifiers.features.astype(np.float32)
    cells = lloyd.bound_cells(points, _cells(identifiers, identifiers.cell_bits))
    candidates = planes.nearest_clusters(cells, points[found.members], _CANDIDATES)
    labels = found.labels
    for _ in range(PLANE_ROUNDS):
        fitted = planes.fit(points, features, identifiers.counts, labels, found.K, FLATNESS)
        labels = planes.nearest_planes(points, features, cells, candidates, fitted)
    held, compact = np.unique(labels, return_inverse=True)
    return Clusters(compact.astype(np.int32), found.members[held])


def _coarse_centres(identifiers: Identifiers, clusters: int, random: np.random.Generator) -> npt.NDArray[np.float32]:
    """Return k-means centres of the means of colour cells.

    The cells are the largest whose number is at least several times that of the clusters.
    """
    for bits in range(identifiers.cell_bits, 9):
        start = _cells(identifiers, bits)
        if len(start) > _GROUPS_PER_CLUSTER * clusters or bits == 8:
            break
    groups = lloyd.group(identifiers.points, identifiers.counts, start)
    firsts = replace(identifiers, codes=identifiers.codes[start[:-1]])
    cells = lloyd.bound_cells(groups.mean, _cells(firsts, bits - 1))

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


def _cells(identifiers: Identifiers, bits: int) -> npt.NDArray[np.int64]:
    """Return the start of each cell of colours with this number of bits per channel, and the end of the last."""
    return runs(identifiers.cells_of(bits))


DIMENSIONS = 32  # dimensions of a point; the other principal components have less than 0.1 % of the inertia


_SAMPLE = 20_000  # number of colours from which the principal components are computed


_COLOUR_BYTES = 300  # per colour while it is identified, clustered and baked into maps (160 to 288 measured)
_CHANNEL_BYTES = 16  # and per channel beyond three


_OUTPUT_BYTES = 20  # per output of the sample (20 measured)


@dataclass(frozen=True, eq=False)
class Identifiers:
    """u distinct colours of the used texels, in the order of their codes; a colour has F channels, the features.

    codes   (u,) uint32 or uint64, see kernels.cluster.colours
    counts  (u,) float64: number of texels of each colour
    points  (u, p) float32: principal components of the MLP's outputs (0..255) in all directions; distances between
            points are distances between outputs, over all channels and directions
    channels  F
    """

    codes: Codes
    counts: npt.NDArray[np.float64]
    points: npt.NDArray[np.float32]
    channels: int = 3

    @property
    def features(self) -> npt.NDArray[np.float64]:
        """The colours (u, F) in 0..1."""
        return colours_of(self.codes, self.channels) / 255

    @property
    def cell_bits(self) -> int:
        """The bits of a channel that number cells of colours."""
        return _CELL_BITS if self.channels <= 3 else _CELL_BITS_OF_MANY

    def cells_of(self, bits: int) -> Codes:
        """The number (u,) of each colour's cell, for cells of this number of bits per channel."""
        return self.codes >> self.codes.dtype.type(self.channels * (8 - bits))


def identify_colours(
    field: SpecularField,
    *,
    directions: npt.NDArray[np.float64],
    direction_weights: npt.NDArray[np.float64] | None = None,
) -> Identifiers:
    """Return the distinct colours, and the MLP's outputs for them in N unit directions (N, 3), reduced to p numbers.

    direction_weights (N,): weight of each direction, 1 on average. The u x 3N outputs (1.7 GB for a 2048x2048
    texture) are projected one colour at a time and never stored. Raises MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import identify_colours, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> identifiers = identify_colours(field, directions=np.eye(3))
    >>> int(identifiers.counts.sum()) == int(field.used.sum())
    True
    """
    # Sorting is faster than counting in a table of all 2^24 colours: 0.25 s against 0.69 s for 4 million texels.
    codes, counts = np.unique(codes_of(field.features[field.used]), return_counts=True)
    per_colour = _COLOUR_BYTES + _CHANNEL_BYTES * max(field.channels - 3, 0)
    memory.require(f"{len(codes):,} colours", len(codes) * per_colour)
    features = colours_of(codes, field.channels) / 255
    basis, shift = _principal_components(field, features, counts, directions, direction_weights)
    points = mlp.project(features, mlp.split_layers(directions, *field.mlp), basis, shift)
    return Identifiers(codes, counts.astype(np.float64), points, field.channels)


def _principal_components(
    field: SpecularField,
    features: npt.NDArray[np.float64],
    counts: npt.NDArray[np.int64],
    directions: npt.NDArray[np.float64],
    direction_weights: npt.NDArray[np.float64] | None,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return basis (3N, p) and shift (p,); the components are outputs @ basis - shift.

    They are computed from an evenly spaced sample of the colours.
    """
    taken = slice(None, None, -(-len(features) // _SAMPLE))
    scale = np.full((3, len(directions)), 255.0)
    if direction_weights is not None:
        scale *= np.sqrt(direction_weights)
    sampled = len(range(len(features))[taken])
    memory.require(f"{sampled:,} colours in {len(directions):,} directions", sampled * scale.size * _OUTPUT_BYTES)
    outputs = mlp.evaluate(features[taken], directions, *field.mlp).reshape(-1, scale.size) * scale.reshape(-1)
    weight = counts[taken] / counts[taken].sum()
    mean = product(weight[None], outputs)
    axes = principal_axes((outputs - mean) * np.sqrt(weight)[:, None], min(DIMENSIONS, scale.size))
    return (scale.reshape(-1, 1) * axes).astype(np.float32), product(mean, axes)[0].astype(np.float32)
