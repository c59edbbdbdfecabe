"""Scenes in the cells of notebooks: what they give when they are asked how they look."""

from __future__ import annotations

import base64
import io
import re
from functools import cache
from html import escape
from html.parser import HTMLParser
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

import nerfbake
from nerfbake import (
    Depth,
    EnvironmentMap,
    Meshes,
    bake_stage1,
    build_bricks,
    build_field,
    build_octree,
    build_vdb,
    build_views,
    compare_scenes,
    orbit_cameras,
    render_field,
    sample_n3tree,
    sample_stage1,
    view,
)
from nerfbake.formats.page import comparison as comparison_page
from nerfbake.formats.page import view as view_page
from nerfbake.scene.base import Scene
from nerfbake.scene.compact_repr import CompactRepr
from tests.scene.test_shipment import ALL as SHIPMENT
from tests.support.lattices import some_lattice
from tests.support.meshes import sphere
from tests.support.quantised import random_quantised
from tests.support.source import public_names_of
from tests.support.vdb_readers import tree, volume


class Frames(HTMLParser):
    """The frames of a text, and whatever else is in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.frames: list[dict[str, Any]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag == "iframe"
        self.frames.append(dict(attrs))

    def handle_data(self, data: str) -> None:
        raise AssertionError(data)


def framed(text: str | None) -> dict[str, Any]:
    assert text is not None
    (frame,) = Frames(text).frames
    return frame


def test_a_picture_is_a_png_of_its_own_pixels() -> None:
    field = build_field(sample_n3tree(resolution=8))
    (camera,) = orbit_cameras(field, width=12, height=10).cameras
    for background in ((1.0, 1.0, 1.0), None):
        image = render_field(field, camera, background=background)
        with Pillow.open(io.BytesIO(image._repr_png_())) as shown:
            assert shown.format == "PNG"
            np.testing.assert_array_equal(np.asarray(shown), image.pixels)


def test_a_comparison_is_its_page_without_the_right_to_run_anything() -> None:
    tree = sample_n3tree(resolution=8)
    found = compare_scenes(tree, tree, orbit_cameras(build_field(tree), width=12, height=10))
    frame = framed(found._repr_html_())
    assert frame["sandbox"] == ""
    assert frame["srcdoc"].encode() == b"".join(comparison_page.encode(found))


def test_a_view_is_its_page_in_a_frame_that_may_run_its_own_script_alone() -> None:
    page = view(sample_n3tree(resolution=8), title='"><script>alert(1)</script>')
    frame = framed(page._repr_html_())
    assert frame["sandbox"] == "allow-scripts"  # and not same-origin: it cannot reach the notebook
    assert frame["srcdoc"].encode() == b"".join(view_page.encode(page))


@cache
def scenes() -> dict[str, Any]:
    """One of each kind that a notebook is likely to hold."""
    tree, stage1 = sample_n3tree(resolution=16), sample_stage1(resolution=16)
    octree, field = build_octree(tree), build_field(tree)
    volume, cameras = build_vdb(octree), orbit_cameras(field, frames=3, width=12, height=10)
    pictures = [render_field(field, camera, background=None).pixels for camera in cameras.cameras]
    found = [tree, octree, field, volume, volume.grids[0], build_vdb(octree, grids=("index",)).grids[0], cameras]
    found += [cameras.cameras[0], build_views(cameras, pictures), stage1, stage1.fields[0], build_bricks(octree)]
    found += [bake_stage1(stage1, clusters=3, map_size=8), compare_scenes(tree, octree, cameras), view(tree)]
    found += [
        render_field(field, cameras.cameras[0]),
        Meshes((sphere(),)),
        sphere(),
        Depth(np.ones((3, 4), np.float32)),
        EnvironmentMap(np.ones((2, 4, 3), np.float32)),
    ]
    found += [some_lattice(), random_quantised(0), SHIPMENT]
    return {type(scene).__name__: scene for scene in found}


NAMES = [
    "BakedAtlas",
    "BrickField",
    "Camera",
    "Cameras",
    "Comparison",
    "Depth",
    "EnvironmentMap",
    "Image",
    "IndexGrid",
    "LatticeField",
    "Mesh",
    "Meshes",
    "N3Tree",
    "Page",
    "QuantisedOctree",
    "RadianceField",
    "Shipment",
    "SparseVoxelOctree",
    "SpecularField",
    "Stage1",
    "VdbTree",
    "Views",
    "Volume",
]
WITH_TABLES = [name for name in NAMES if issubclass(getattr(nerfbake, name), Scene)]


@pytest.mark.parametrize("name", NAMES)
def test_a_repr_fits_on_three_lines_of_80_characters(name: str) -> None:
    text = repr(scenes()[name])
    assert name in text
    assert "\n" not in text
    assert len(text) <= 240
    assert "array(" not in text


def test_every_type_of_scene_has_a_short_repr() -> None:
    for name, module in public_names_of("scene").items():
        assert issubclass(getattr(import_module(module), name), CompactRepr), name


@pytest.mark.parametrize("name", WITH_TABLES)
def test_a_notebook_gets_a_small_table(name: str) -> None:
    html = scenes()[name]._repr_html_()
    if name == "Image":
        assert html is None  # a notebook shows the picture itself
        return
    assert len(html) < 100_000 or name == "Page"
    assert name in ("Comparison", "Page", "Shipment") or f"<th>scene</th><td>{escape(str(scenes()[name]))}</td>" in html


@pytest.mark.parametrize("name", ["N3Tree", "SparseVoxelOctree", "Volume", "Meshes", "LatticeField"])
def test_a_table_has_a_thumbnail_of_what_can_be_seen(name: str) -> None:
    (data,) = re.findall(r'<img src="data:image/png;base64,([^"]+)" width="160"', scenes()[name]._repr_html_())
    with Pillow.open(io.BytesIO(base64.b64decode(data))) as picture:
        assert picture.size == (160, 160)
        assert len(np.unique(np.asarray(picture))) > 10


def test_names_in_a_table_are_text() -> None:
    html = volume(tree([[0, 0, 0]], name="<script>alert(1)</script>"))._repr_html_()
    assert html is not None
    assert "<script" not in html
    assert "&lt;script&gt;" in html


def test_a_broken_scene_has_a_table_without_a_thumbnail() -> None:
    broken = sample_n3tree(resolution=8)
    broken.data[:] = np.nan
    html = broken._repr_html_()
    assert html is not None
    assert "<img" not in html
    assert "PlenOctree" in html
