from __future__ import annotations

import base64
import io
import json
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Comparison, Image, build_field, compare_scenes, orbit_cameras
from nerfbake.formats.page import comparison as comparison_html
from nerfbake.scene.camera import Cameras
from tests.support.scenes import n3tree

HOSTILE = '"><img src=x onerror=alert(1)></title><script>alert(2)</script>&amp;\n\x1b[2J\u202e\udcff'
VOID = {"meta", "img"}


class Page(HTMLParser):
    """Tags with their attributes, texts, the figures of `data` elements, and whether every tag is closed."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.figures: list[tuple[str, str]] = []
        self.feed(page.decode())
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "data":
            self.figures.append((str(self.tags[-1][1]["value"]), data))
        self.text += data

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def compared(*, truth: bool = True, names: tuple[str, str] = ("one", "two")) -> Comparison:
    a = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=np.float32)
    b = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=np.float32)
    b.data[..., -1] += 0.5
    cameras = orbit_cameras(build_field(a), frames=2, width=20, height=16).cameras
    named = Cameras(tuple(replace(camera, name=name) for camera, name in zip(cameras, names, strict=True)))
    grey, whole = np.full((16, 20, 3), 0.5, np.float32), np.ones((16, 20), np.float32)
    return compare_scenes(a, b, named, truth=[Image(grey, whole, whole)] * 2 if truth else None)


def page_of(comparison: Comparison, **options: Any) -> bytes:
    return b"".join(comparison_html.encode(comparison, **options))


def numbers(value: Any) -> list[float]:
    """Every number in what --json prints."""
    match value:
        case dict():
            return [number for part in value.values() for number in numbers(part)]
        case list() | tuple():
            return [number for part in value for number in numbers(part)]
        case bool() | str() | None:
            return []
        case _:
            return [value]


def test_every_figure_is_the_one_that_a_script_reads() -> None:
    found = compared()
    sizes = {"a": {"bytes": 4096, "name": "a.npz"}, "b": {"bytes": 1024, "name": "b.npz"}}
    page = Page(page_of(found, **sizes, min_psnr=20.5, max_error=0.25))
    told = json.loads(json.dumps([found.views, found.means, found.values, 4096, 1024]))
    budgets = [20.5, 0.25, 1024 / 4096]
    written = [float(value) for value, _ in page.figures]
    assert set(written) == set(numbers(told) + budgets)
    for value, shown in page.figures:
        number = float(shown.replace(",", "").rstrip("%")) / (100 if shown.endswith("%") else 1)
        assert number == pytest.approx(float(value), rel=1e-3, abs=5e-5 if float(value) < 1 else 5e-3)


def test_the_page_needs_nothing_but_itself() -> None:
    data = page_of(compared())
    page = Page(data)
    assert {tag for tag, _ in page.tags}.isdisjoint({"script", "link", "iframe", "object", "a", "base", "form"})
    assert b"http:" not in data
    assert b"https:" not in data
    assert b"url(" not in data
    assert b"@import" not in data
    sources = [attributes["src"] or "" for attributes in page.named("img")]
    assert len(sources) == 2 * 6
    assert all(source.startswith("data:image/png;base64,") for source in sources)


def test_the_pictures_are_the_pictures() -> None:
    found = compared()
    sources = [attributes["src"] or "" for attributes in Page(page_of(found)).named("img")]
    expected = [image for row in found.rows() for image in row.values()]
    for source, image in zip(sources, expected, strict=True):
        with Pillow.open(io.BytesIO(base64.b64decode(source.partition(",")[2]))) as picture:
            assert np.asarray(picture).tolist() == image.pixels.tolist()
    assert list(next(found.rows())) == ["truth", "a", "b", "a_b", "a_truth", "b_truth"]
    truth, a, b, *differences = (image.colour for image in expected[:6])
    for difference, one, other in zip(differences, (a, a, b), (b, truth, truth), strict=True):
        assert difference == pytest.approx(np.clip(8 * np.abs(one - other), 0, 1))
    captions = Page(page_of(found)).text
    for words in ("A and B", "A and truth", "B and truth"):
        assert captions.count(f"{words}: difference, 8 times as strong") == 2


def test_a_hostile_name_is_text() -> None:
    found = compared(names=(HOSTILE, "two"))
    data = page_of(found, a={"name": HOSTILE, "content": HOSTILE}, b={"name": f"folder/{HOSTILE}"})
    page = Page(data)
    harmless = Page(page_of(compared(), a={"name": "a", "content": "b"}, b={"name": "c"}))
    assert [tag for tag, _ in page.tags] == [tag for tag, _ in harmless.tags]
    assert [sorted(attributes) for _, attributes in page.tags] == [sorted(given) for _, given in harmless.tags]
    assert "<script>alert(2)</script>&amp; [2J" in page.text
    assert not {"\x1b", "\u202e"} & set(page.text)


def test_the_verdict() -> None:
    found = compared()
    psnr, error = found.means["a_b"]["psnr"], found.means["a_b"]["max_error"]
    assert "No budget was set." in Page(page_of(found)).text
    kept = Page(page_of(found, min_psnr=psnr, max_error=error)).text
    assert "Within budget" in kept
    assert kept.count(": holds") == 2
    missed = Page(page_of(found, min_psnr=psnr + 1, max_error=error)).text
    assert "Budget missed" in missed
    assert (missed.count(": holds"), missed.count(": missed")) == (1, 1)


def test_what_there_is_not_is_not_shown() -> None:
    bare = compared(truth=False)
    assert len(Page(page_of(bare)).named("img")) == 2 * 3
    nothing = Comparison(bare.views, {}, ())
    page = Page(page_of(nothing))
    assert page.named("img") == []
    assert "values of different kinds" in page.text
    assert "B / A" not in page.text


def test_same_comparison_same_bytes() -> None:
    assert page_of(compared(), min_psnr=3.0) == page_of(compared(), min_psnr=3.0)
