"""Specular field -> its distinct colours, and for each a point that says how it looks from everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.cluster import colours
from nerfbake.kernels.maths.products import principal_axes, product
from nerfbake.kernels.surface import mlp
from nerfbake.scene.specular import SpecularField

DIMENSIONS = 32  # of a point: what the principal components leave out is below 0.1 % of the inertia
_SAMPLE = 20_000  # colours that the principal components are found from
_COLOUR_BYTES = 300  # a colour while it is told from others, clustered, and shown in maps (160 to 288 measured)
_OUTPUT_BYTES = 20  # an output of the sample (20 measured)


@dataclass(frozen=True, eq=False)
class Identifiers:
    """u distinct colours of the used texels, in the order of their codes.

    codes   (u,) uint32, kernels.colours
    counts  (u,) float64: texels of each colour
    points  (u, p) float32: the MLP's outputs (0..255) in all directions, in principal components; distances between
            points are distances between outputs, over all channels and directions
    """

    codes: npt.NDArray[np.uint32]
    counts: npt.NDArray[np.float64]
    points: npt.NDArray[np.float32]

    @property
    def features(self) -> npt.NDArray[np.float64]:
        """(u, 3) in 0..1."""
        return colours.colours_of(self.codes) / 255


def identify_colours(
    field: SpecularField,
    *,
    directions: npt.NDArray[np.float64],
    direction_weights: npt.NDArray[np.float64] | None = None,
) -> Identifiers:
    """The distinct colours, and the MLP's outputs for them in N unit directions (N, 3), reduced to p numbers.

    direction_weights (N,): how much each direction counts, 1 on average. The u x 3N outputs (1.7 GB for a 2048x2048
    texture) are projected one colour at a time and never stored. Raises MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import identify_colours, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> identifiers = identify_colours(field, directions=np.eye(3))
    >>> int(identifiers.counts.sum()) == int(field.used.sum())
    True
    """
    # Sorting beats counting in a table of all 2^24 colours: 0.25 s against 0.69 s for 4 million texels.
    codes, counts = np.unique(colours.codes_of(field.features[field.used]), return_counts=True)
    memory.require(f"{len(codes):,} colours", len(codes) * _COLOUR_BYTES)
    features = colours.colours_of(codes) / 255
    basis, shift = _principal_components(field, features, counts, directions, direction_weights)
    points = mlp.project(features, mlp.split_layers(directions, field.w0, field.w1), basis, shift)
    return Identifiers(codes, counts.astype(np.float64), points)


def _principal_components(
    field: SpecularField,
    features: npt.NDArray[np.float64],
    counts: npt.NDArray[np.int64],
    directions: npt.NDArray[np.float64],
    direction_weights: npt.NDArray[np.float64] | None,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """(3N, p) and (p,): outputs @ basis - shift are the components, of an evenly taken sample of the colours."""
    taken = slice(None, None, -(-len(features) // _SAMPLE))
    scale = np.full((3, len(directions)), 255.0)
    if direction_weights is not None:
        scale *= np.sqrt(direction_weights)
    sampled = len(range(len(features))[taken])
    memory.require(f"{sampled:,} colours in {len(directions):,} directions", sampled * scale.size * _OUTPUT_BYTES)
    outputs = mlp.evaluate(features[taken], directions, field.w0, field.w1).reshape(-1, scale.size) * scale.reshape(-1)
    weight = counts[taken] / counts[taken].sum()
    mean = product(weight[None], outputs)
    axes = principal_axes((outputs - mean) * np.sqrt(weight)[:, None], min(DIMENSIONS, scale.size))
    return (scale.reshape(-1, 1) * axes).astype(np.float32), product(mean, axes)[0].astype(np.float32)
