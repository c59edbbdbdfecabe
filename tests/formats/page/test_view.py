"""The page as bytes; tests/shaders/test_page.py opens it in a browser."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest

from nerfbake import (
    Page,
    PageField,
    QuantisedOctree,
    SparseVoxelOctree,
    build_field,
    build_octree,
    build_page_field,
    quantise_octree,
    render_field,
    sample_n3tree,
    scatter_cameras,
    weigh_leaves,
)
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.octree import svoq
from nerfbake.formats.page import view as view_html
from tests.support.viewed import view_of


@pytest.fixture(scope="module")
def view() -> Page:
    field = build_field(build_octree(sample_n3tree(resolution=16)))
    return view_of(build_page_field(field), field, "A <page> & more")


@pytest.fixture(scope="module")
def quantised(view: Page) -> QuantisedOctree:
    assert view.field is not None
    importance = weigh_leaves(view.field, scatter_cameras(view.field, frames=2, edge=16))
    return quantise_octree(build_octree(sample_n3tree(resolution=16)), importance, step=0.1, prune=0.1)


def page_of(view: Page) -> str:
    return b"".join(view_html.encode(view)).decode()


def facts_of(page: str) -> dict[str, object]:
    found = re.search(r'id="facts">(.*?)</script>', page)
    assert found
    facts: dict[str, object] = json.loads(found[1])
    return facts


def data_of(page: str) -> bytes:
    found = re.search(r'id="data">(.*?)</script>', page)
    assert found
    assert len(found[1]) == facts_of(page)["length"]
    return base64.b64decode(found[1], validate=True)


def test_the_same_view_is_the_same_bytes_and_their_number_is_known(view: Page) -> None:
    assert page_of(view) == page_of(view)
    assert view_html.coded_size(view) == len(page_of(view).encode())


def test_a_large_grid_is_packed_from_where_it_lies(view: Page) -> None:
    """Two copies more were made: 270 MB too many of an octree of 4096^3 with six leaves."""
    assert isinstance(view.content, PageField)
    content = replace(view.content, top=np.full((256, 256, 256), -1, np.int32))
    tracemalloc.start()
    b"".join(view_html.encode(replace(view, content=content)))
    assert tracemalloc.get_traced_memory()[1] < 2.25 * content.top.nbytes  # the stream's bytes, and room for it
    tracemalloc.stop()


def test_the_policy_lets_its_own_script_and_style_run_and_nothing_else(view: Page) -> None:
    page = page_of(view)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy
    allowed = dict(part.split(" ", 1) for part in policy[1].split("; "))
    assert allowed["default-src"] == allowed["base-uri"] == allowed["form-action"] == "'none'"
    assert set(allowed) == {"default-src", "base-uri", "form-action", "script-src", "style-src", "img-src"}
    assert allowed["img-src"] == "data:"
    [script] = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    [style] = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    for text, name in ((script, "script-src"), (style, "style-src")):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert allowed[name] == f"'sha256-{digest}'"
    assert not re.search(r"https?://|\son\w+=|{{", page)


def test_the_title_is_text(view: Page) -> None:
    page = page_of(view)
    assert "<title>A &lt;page&gt; &amp; more</title>" in page
    assert '<meta property="og:title" content="A &lt;page&gt; &amp; more">' in page
    assert "<page>" not in page


def test_exact_data_are_the_page_fields_arrays(view: Page) -> None:
    page, content = page_of(view), view.content
    facts, raw = facts_of(page), zlib.decompress(data_of(page))
    assert isinstance(content, PageField)
    top, blocks, texels = content.top, content.blocks, content.texels
    assert (facts["kind"], facts["size"], facts["rows"]) == ("arrays", len(raw), len(texels))
    assert raw[: top.nbytes] == top.tobytes()
    assert raw[top.nbytes : top.nbytes + blocks.nbytes] == blocks.tobytes()
    planes = np.frombuffer(raw[top.nbytes + blocks.nbytes :], np.uint8).reshape(-1, 2, len(texels)).astype(np.uint16)
    halves = (planes[:, 0] | planes[:, 1] << 8).view(np.float16).T
    np.testing.assert_array_equal(halves.reshape(texels.shape), texels)


def test_compressed_data_are_the_bytes_of_a_svoq(view: Page, quantised: QuantisedOctree) -> None:
    page, file = page_of(replace(view, content=quantised)), b"".join(svoq.encode(quantised))
    assert facts_of(page)["kind"] == "svoq"
    assert data_of(page) == file
    carried = replace(view, content=file)
    assert page_of(carried) == page
    assert str(carried) == f"page of a compressed octree of {len(file):,} bytes"


def test_a_file_in_a_coding_that_the_script_does_not_read_is_carried_in_the_other_one(
    quantised: QuantisedOctree,
) -> None:
    ranged, deflated = (b"".join(svoq.encode(quantised, coding=coding)) for coding in svoq.CODINGS)
    assert (
        view_html.script_readable(memoryview(ranged))
        == view_html.script_readable(memoryview(deflated))
        == ranged
        != deflated
    )


def test_a_cover_is_square(view: Page) -> None:
    assert view.field is not None
    with pytest.raises(InvalidScene, match="the cover has 24x12 pixels; allowed: a square picture"):
        replace(view, cover=render_field(view.field, view.cameras.cameras[0].resized(24, 12)))


def test_what_a_compressed_page_carries_comes_back(view: Page, quantised: QuantisedOctree) -> None:
    found = view_html.content_of(memoryview(page_of(replace(view, content=quantised)).encode()))
    assert isinstance(found, SparseVoxelOctree)
    assert (found.node_data == quantised.restored().node_data).all()


def test_what_an_exact_page_carries_comes_back(view: Page) -> None:
    found = view_html.content_of(memoryview(page_of(view).encode()))
    assert isinstance(found, PageField)
    assert isinstance(view.content, PageField)
    for name in ("top", "blocks", "texels", "place", "box"):
        np.testing.assert_array_equal(getattr(found, name), getattr(view.content, name))
    assert (found.density_unit, found.basis) == (view.content.density_unit, view.content.basis)


def test_what_is_no_page_is_refused() -> None:
    with pytest.raises(InvalidFile, match="is not a complete page"):
        view_html.content_of(memoryview(b"<!DOCTYPE html>"))
