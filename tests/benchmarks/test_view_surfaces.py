"""The view benchmark of a stage-1 folder: the MLP and the atlases baked from it, drawn in turn."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks import view
from benchmarks.browser import SWIFTSHADER
from nerfbake import sample_stage1
from nerfbake.scene.atlas import METHODS
from tests.bench.conftest import quiet
from tests.support.browser import with_a_browser_of_its_own

pytestmark = [pytest.mark.tools, pytest.mark.slow]


@with_a_browser_of_its_own
def test_every_way_to_the_highlights_is_drawn_compared_and_timed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small: dict[str, Any] = {"directions": 20, "clusters": 4, "map_size": 8, "nodes": 2}
    monkeypatch.setattr(view, "FRAMES", 3)  # of one, the atlas takes less than the clock shows
    scene = sample_stage1(resolution=32)
    report = view.compare_surfaces(scene, "small", rounds=2, progress=quiet, flags=SWIFTSHADER, edge=160, **small)
    frames, thesis = report.tables
    found = (dict(zip(frames.columns, row, strict=True)) for row in frames.rows)
    rows = {row["highlights"]: row for row in found}
    assert list(rows) == [*view.MLPS, *METHODS, "none"]
    for way, row in rows.items():
        assert row["pixels"] == "160x160"
        assert (row["PSNR dB"] is None) == (row["textures MB"] is None) == (way == "none")
    # At least half of what is aimed for; the mesh itself costs the same with all of them.
    assert rows["mlp_textures"]["x kmeans"].median > 2
    assert thesis.title.startswith("The thesis, section 3.1")
