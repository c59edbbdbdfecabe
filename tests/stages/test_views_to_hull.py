from __future__ import annotations

import numpy as np

from nerfbake import build_octree, carve_hull, sample_n3tree
from tests.support.views import sample_views


def test_the_hull_holds_all_of_the_object_and_little_more() -> None:
    hull = carve_hull(sample_views(), resolution=32)
    hull.require_usable()
    octree = build_octree(sample_n3tree(resolution=32), resolution=32)
    edge = (np.stack(np.meshgrid(*[np.arange(32) + 0.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3) / 32 - 0.5) * 2.5
    full = octree.sample(edge)[:, -1] > 0
    held = hull.sample(edge)[:, -1] > 0
    assert held[full].mean() > 0.999
    assert held.mean() < 3 * full.mean()
    assert (hull.box[1] - hull.box[0] < 3.1).all()
