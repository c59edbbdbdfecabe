"""The view benchmark: pages in a browser that take turns, and what they are measured against."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest

import nerfbake
from benchmarks import view
from benchmarks.browser import SWIFTSHADER, chromium
from benchmarks.view import octree_content, with_octree_lookup
from nerfbake import (
    Camera,
    Cameras,
    Page,
    RadianceField,
    build_field,
    build_octree,
    build_page_field,
    orbit_cameras,
    render_field,
    sample_n3tree,
    save,
)
from nerfbake.bench.report import markdown
from nerfbake.errors import NerfbakeError
from nerfbake.scene.page import grid_of
from tests.bench.conftest import quiet
from tests.support.browser import with_a_browser_of_its_own

EDGE = 48


def field() -> RadianceField:
    """Leaves at several levels, in a grid that is no power of two, and whose box does not start at its corner."""
    octree = build_octree(sample_n3tree(resolution=32, basis="SH4"), resolution=(27, 32, 21))
    return build_field(replace(octree, voxel_size=np.array([1.0, 2.0, 0.5])))


def descended(table: npt.NDArray[np.int32], height: int, points: npt.NDArray[np.int64]) -> list[int]:
    """The row at each voxel of an octree, by octree.glsl's way down."""
    found = []
    for point in points:
        node = 0
        for shift in range(height - 1, -1, -1):
            x, y, z = point >> shift & 1
            node = int(table[2 * node + x, 2 * y + z])
            if node < 0:
                break
        found.append(-2 - node if node < -1 else -1)
    return found


def test_the_way_down_leads_to_the_same_rows() -> None:
    scene = field()
    arranged = build_page_field(scene)
    content = octree_content(scene, arranged)
    start, _ = grid_of(scene.box)
    random = np.random.default_rng(0)
    voxels = random.integers(start, np.ceil(scene.box[1]).astype(int), (3000, 3))
    wanted = arranged.rows((voxels - start).astype(np.float64))
    assert (wanted >= 0).sum() > 100 < (wanted < 0).sum()
    found = descended(content.blocks.view(np.int32), len(scene.cells.bits), voxels)
    # A leaf is one row to the octree, and a row for each of its voxels to the page.
    np.testing.assert_array_equal(np.array(found) < 0, wanted < 0)
    held = wanted >= 0
    np.testing.assert_array_equal(content.texels[np.array(found)[held]], arranged.texels[wanted[held]])


def test_the_lookup_alone_is_another_one(tmp_path: Path) -> None:
    scene = field()
    save(tmp_path / "a.html", nerfbake.view(scene))
    own = (tmp_path / "a.html").read_bytes()
    other = with_octree_lookup(own, scene)
    assert own.count(b"int look(") == other.count(b"int look(") == 1
    assert other.count(b"const int HEIGHT = 5;") == 1
    with pytest.raises(AssertionError, match="no lookup of its own"):
        with_octree_lookup(b"<p>", scene)


@pytest.mark.tools
@pytest.mark.slow
@with_a_browser_of_its_own
def test_both_lookups_are_drawn_compared_and_timed() -> None:
    tree = sample_n3tree(resolution=32, basis="SH4")
    views = orbit_cameras(build_field(tree), frames=2, width=60, height=40).cameras
    report = view.compare_pages(tree, "small", views, rounds=2, progress=quiet, flags=SWIFTSHADER, edge=EDGE)
    assert "SwiftShader" in report.head["drawn by"]
    octree, chosen = (dict(zip(view.COLUMNS, row, strict=True)) for row in report.tables[0].rows)
    assert (octree["page"], chosen["page"]) == (view.OCTREE, view.CHOSEN)
    for row in (octree, chosen):
        assert row["pixels"] == "48x48"
        assert row["PSNR dB"] > 50
        assert row["wall ms a frame"].rounds == 2
    assert chosen["structure MB"] < octree["structure MB"]
    text = markdown(report)
    assert "TR-24-01, table 3, as context" in text
    assert "The thesis, section 3.1, as context" in text
    assert view.chart_pages(report, ".svg").startswith(b"<?xml")


class WhiteTab:
    """A page that draws white pictures, and must not be timed."""

    def pictures(self, views: Sequence[Camera], edge: int) -> list[npt.NDArray[np.uint8]]:
        return [np.full((edge, edge, 3), 255, np.uint8) for _ in views]


def test_a_page_that_draws_something_else_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    browser = SimpleNamespace(opened=lambda path: nullcontext(WhiteTab()))
    monkeypatch.setattr(view, "chromium", lambda flags: nullcontext(browser))
    tree = sample_n3tree(resolution=16, basis="SH1")
    with pytest.raises(NerfbakeError, match=r"dB from `nerfbake render`; allowed: 50 or more"):
        view.compare_pages(tree, "small", rounds=1, progress=quiet, flags=SWIFTSHADER, edge=EDGE)


@pytest.mark.tools
@pytest.mark.slow
@with_a_browser_of_its_own
def test_a_browser_without_webgl_says_so(tmp_path: Path) -> None:
    scene = field()
    cameras = orbit_cameras(scene, width=8, height=8)
    cover = render_field(scene, cameras.cameras[0])
    save(tmp_path / "a.html", Page(build_page_field(scene), scene, Cameras(cameras.cameras), cover))
    with (
        pytest.raises(NerfbakeError, match="needs WebGL 2"),
        chromium(["--disable-3d-apis"]) as browser,
        browser.opened(tmp_path / "a.html"),
    ):
        pass
