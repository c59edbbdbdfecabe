"""Scenes in the cells of notebooks: what they give when they are asked how they look."""

from __future__ import annotations

import io
from html.parser import HTMLParser
from typing import Any

import numpy as np
from PIL import Image as Pillow

from nerfbake import build_field, compare_scenes, orbit_cameras, render_field, sample_n3tree, view
from nerfbake.formats.page import comparison as comparison_page
from nerfbake.formats.page import view as view_page


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


def framed(text: str) -> dict[str, Any]:
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
