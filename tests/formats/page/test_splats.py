"""The splats of a page as bytes; tests/shaders/test_page_splats.py opens it in a browser."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

import numpy as np
import pytest

from nerfbake import Page, PageSplats, Splats, build_page_splats, orbit_cameras, render_splats
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.page import view as view_html
from nerfbake.formats.page.splats import pack_splats, splat_facts, unpack_splats
from nerfbake.formats.wire.deflate import inflate
from nerfbake.memory import memory_limit, scope
from tests.support.splats import splats

ARRAYS = ("places", "scales", "turns", "opacity", "colours", "rest", "box", "origin")


def page_of(scene: Splats) -> Page:
    cameras = orbit_cameras(scene, width=8, height=8)
    return Page(build_page_splats(scene), None, cameras, render_splats(scene, cameras.cameras[0]))


@pytest.fixture(scope="module")
def page() -> Page:
    return page_of(splats(40, degree=2, antialiased=True))


@pytest.fixture(scope="module")
def text(page: Page) -> str:
    return b"".join(view_html.encode(page)).decode()


@pytest.mark.parametrize("degree", range(5))
def test_what_a_page_carries_comes_back(degree: int) -> None:
    page = page_of(splats(30, degree=degree))
    found = view_html.content_of(memoryview(b"".join(view_html.encode(page))))
    assert isinstance(found, PageSplats)
    assert isinstance(page.content, PageSplats)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(page.content, name))
    assert (found.step, found.antialiased, found.up) == (page.content.step, False, None)


def test_the_bytes_of_a_splat_by_hand() -> None:
    one = PageSplats(
        np.array([[1, -2, 300]], np.int32),
        np.array([[640, 1, 0]], np.uint16),
        np.array([[3, 4, 5, 6]], np.uint8),
        np.array([7], np.uint8),
        np.array([[-1, 2, 200]], np.int16),
        np.array([[[-1, 1, 0], [2, -2, 3], [-3, 4, 127]]], np.int8),
        np.array([[0.0, 0, 0], [1, 1, 1]]),
        1.0,
        False,
        None,
        np.zeros(3),
    )
    raw = inflate(memoryview(pack_splats(one)), 38, "")
    places, scales = [2, 0, 0, 0, 3, 0, 0, 0, 88, 2, 0, 0], [128, 2, 1, 0, 0, 0]
    assert list(raw) == [*places, *scales, 3, 4, 5, 6, 7, 1, 0, 4, 0, 144, 1, 1, 2, 0, 4, 3, 6, 5, 8, 254]


def test_the_box_is_that_of_right_forward_and_up() -> None:
    scene = splats(200, degree=0)
    facts = splat_facts(build_page_splats(scene))
    assert facts["up"] == [0, -1, 0]
    place = np.array(facts["place"])
    corners = np.array([facts["low"], facts["high"]])
    found = corners @ place[:, :3].T + place[:, 3]
    np.testing.assert_allclose(np.sort(found, axis=0), [[0, 0, 0], [1, 1, 1]], atol=1e-9)


def test_its_script_has_what_it_needs_alone(text: str) -> None:
    assert "class SplatPicture" in text
    assert "class Picture " not in text
    assert "worker-src blob:" in text
    assert len(text) < 140_000  # 40 splats: the page itself


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("splats", 0, InvalidFile),
        ("splats", 41, InvalidFile),
        ("splats", 1 << 40, InvalidFile),
        ("functions", 5, InvalidFile),
        ("stated", "w", InvalidFile),
        ("splats", 1 << 25, MemoryLimit),
    ],
)
def test_facts_that_do_not_fit_are_refused(page: Page, name: str, value: object, error: type[Exception]) -> None:
    assert isinstance(page.content, PageSplats)
    facts = splat_facts(page.content) | {name: value}
    with memory_limit(1 << 30), scope(), pytest.raises(error):
        unpack_splats(memoryview(pack_splats(page.content)), facts)


@pytest.mark.parametrize("damage", [lambda data: data[:-9], lambda data: data[:20] + b"\0\0\0" + data[23:]])
def test_damaged_data_are_refused(page: Page, damage: Callable[[bytes], bytes]) -> None:
    assert isinstance(page.content, PageSplats)
    with pytest.raises((InvalidFile, InvalidScene)):
        unpack_splats(memoryview(damage(pack_splats(page.content))), splat_facts(page.content))


def test_the_facts_hold_no_end_of_a_script(text: str) -> None:
    found = re.search(r'id="facts">(.*?)</script>', text)
    assert found
    assert json.loads(found[1])["kind"] == "splats"
