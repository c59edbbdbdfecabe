"""`nerfbake bench view` of a stage-1 folder: the MLP and the atlases baked from it, drawn in turn."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from nerfbake import sample_stage1
from nerfbake.bench.view import surfaces
from nerfbake.bench.view.browser import SWIFTSHADER
from nerfbake.cli.main import run
from nerfbake.io import save_folder
from nerfbake.scene.atlas import METHODS
from tests.support.browser import with_a_browser_of_its_own
from tests.support.outputs import read_output

pytestmark = [pytest.mark.tools, pytest.mark.slow]


@with_a_browser_of_its_own
def test_every_way_to_the_highlights_is_drawn_compared_and_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small: dict[str, Any] = {"directions": 20, "clusters": 4, "map_size": 8, "nodes": 2}
    compare = partial(surfaces.compare_surfaces, flags=SWIFTSHADER, edge=160, **small)
    monkeypatch.setattr(surfaces, "compare_surfaces", compare)
    monkeypatch.setattr(surfaces, "FRAMES", 3)  # of one, the atlas takes less than the clock shows
    monkeypatch.chdir(tmp_path)
    save_folder(tmp_path / "stage1", sample_stage1(resolution=32))
    assert run(["bench", "view", "stage1", "--rounds", "2", "--format", "json", "--plot", "a.svg", "-q"]) == 0
    report = read_output("bench", capsys.readouterr().out)
    frames, thesis = report["tables"]
    rows = {row["highlights"]: row for row in frames["rows"]}
    assert list(rows) == [*surfaces.MLPS, *METHODS, "none"]
    for way, row in rows.items():
        assert row["pixels"] == "160x160"
        assert (row["PSNR dB"] is None) == (row["textures MB"] is None) == (way == "none")
    # At least half of what is aimed for; the mesh itself costs the same with all of them.
    assert rows["mlp_textures"]["x kmeans"] > 2
    assert thesis["title"].startswith("The thesis, section 3.1")
    assert (tmp_path / "a.svg").read_bytes().startswith(b"<?xml")
