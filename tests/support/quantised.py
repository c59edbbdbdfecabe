"""Small quantised octrees."""

from __future__ import annotations

import numpy as np

from nerfbake.scene.basis import parse_basis
from nerfbake.scene.quantised_octree import QuantisedOctree


def random_quantised(
    seed: int, *, levels: int = 3, data_format: str = "SH4", fill: float = 0.5, spread: float = 3.0, size: int = 0
) -> QuantisedOctree:
    """A random octree with leaves on all levels. Coefficients decrease with level and channel."""
    random = np.random.default_rng(seed)
    masks, width, leaves = [np.zeros(0, np.uint8)], 1, 0
    for level in range(levels):
        own = (random.random((width, 8)) < fill) @ (1 << np.arange(8))
        own[random.random(width) < 0.1 * (level > 0)] = 0
        if level == 0 and own[0] == 0:
            own[0] = 1
        masks.append(own.astype(np.uint8))
        leaves += int(np.count_nonzero(own == 0))
        width = int(np.unpackbits(own.astype(np.uint8)).sum())
    m, C = leaves + width, parse_basis(data_format).data_dim
    scale = spread / (1 + np.arange(C)) * (1 + 60 / (1 + np.arange(m)[:, None]))
    values = np.rint(random.laplace(size=(m, C)) * scale).astype(np.int32)
    return QuantisedOctree(
        size=(size or 1 << levels,) * 3,
        masks=np.concatenate(masks),
        values=values,
        mixing=random.integers(-32767, 32768, (C - 1, C - 1)).astype(np.int16),
        mixing_scale=1e-4,
        colour_step=0.06,
        density_step=0.12,
        density_scale=20.0,
        data_format=data_format,
        origin=np.array([-1.0, 0.5, 0.25]),
        voxel_size=np.array([0.25, 0.125, 0.5]),
    )
