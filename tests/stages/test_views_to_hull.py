from __future__ import annotations

from dataclasses import replace

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


def test_rough_masks_that_cut_off_a_part_do_not_remove_it() -> None:
    views = sample_views()
    pictures = [each.copy() for each in views.pictures]
    for each in pictures[:2]:
        each[:, : each.shape[1] // 2, 3] = 0
    cut = replace(views, pictures=tuple(pictures))
    whole, exact, rough = (
        carve_hull(each, box=np.array([[-1.25] * 3, [1.25] * 3]), resolution=32).n
        for each in (views, cut, replace(cut, rough=True))
    )
    assert exact < 0.7 * whole
    assert rough >= whole
