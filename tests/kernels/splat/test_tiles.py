"""Every pixel that a splat reaches is in a tile that lists the splat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import Camera
from nerfbake.kernels.splat.project import SplatArrays, project
from nerfbake.kernels.splat.tiles import EDGE, bent_tiles, count_entries, even_tiles, fill_entries
from nerfbake.scene.camera import look_at
from nerfbake.stages._eye import eye_of
from tests.support.splats import splats


@pytest.mark.parametrize("bent", [False, True])
def test_tiles_list_what_reaches_into_them_in_order(bent: bool) -> None:
    scene = splats(300, seed=1)
    scene = replace(scene, scales=scene.scales * np.array([1, 3, 9], np.float32))
    eye, _ = eye_of(Camera(100, 70, 80.0, look_at(np.zeros(3), 0.4, 0.3, 6.0)))
    rows, _ = project(SplatArrays(scene.means, scene.scales, scene.quats, scene.opacity, scene.sh), eye, False)
    places = np.stack(np.meshgrid(np.arange(100) + 0.5, np.arange(70) + 0.5), axis=-1)
    tiles = bent_tiles(places) if bent else even_tiles(100, 70)
    counts = np.zeros(tiles.rows * tiles.columns, np.int64)
    count_entries(rows, tiles, counts)
    starts = np.cumsum(counts) - counts
    ends, entries = starts.copy(), np.empty(counts.sum(), np.int32)
    fill_entries(rows, tiles, 0, tiles.rows, ends, entries)
    assert_array_equal(ends, starts + counts)
    listed = np.zeros((len(rows), len(counts)), bool)
    for tile, (start, end) in enumerate(zip(starts, ends, strict=True)):
        assert (np.diff(entries[start:end]) > 0).all()
        listed[entries[start:end], tile] = True
    _, columns = divmod(np.arange(70 * 100), 100)
    tile_of = np.arange(70 * 100) // 100 // EDGE * tiles.columns + columns // EDGE
    reached = np.zeros_like(listed)
    for i, (x, x_rest, y, y_rest, xx, xy, yy, *_, reach, _, _, _) in enumerate(rows.astype(np.float64)):
        dx, dy = (places - [x + x_rest, y + y_rest]).reshape(-1, 2).T
        inside = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy <= reach
        reached[i, np.unique(tile_of[inside])] = True
    assert reached.sum() > 500
    assert not (reached & ~listed).any()
    assert listed.sum() < 1.5 * reached.sum()  # and few others
