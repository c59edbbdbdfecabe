"""The page of a shipment: closed tags, no script, no address, and each figure beside what it belongs to."""

from __future__ import annotations

import base64
import io
from dataclasses import replace

import numpy as np
from PIL import Image as Pillow

from nerfbake.formats.page.shipment import encode
from tests.formats.page.test_comparison import HOSTILE, Page
from tests.scene.test_shipment import ALL, EMPTY, JUDGED


def page(shipment: object = ALL) -> Page:
    return Page(b"".join(encode(shipment)))  # type: ignore[arg-type]


def test_each_row_has_its_figures_and_pictures() -> None:
    found = page()
    assert ("1230000", "1.23") not in found.figures  # megabytes
    assert ("1.23", "1.23") in found.figures
    assert {("31.5", "31.50"), ("30.5", "30.50"), ("0.25", "0.250"), ("1.5", "1.5"), ("3.5", "3.5")} <= {*found.figures}
    assert "Failed: x.ply" in found.text
    assert "Failed: no memory" in found.text
    assert "Not judged: no library" in found.text
    pictures = found.named("img")
    assert [each["alt"] for each in pictures] == ["the scene", "x.ply", "difference, 8 times as strong"]
    data = base64.b64decode(str(pictures[1]["src"]).removeprefix("data:image/png;base64,"))
    with Pillow.open(io.BytesIO(data)) as shown:
        assert np.asarray(shown)[0, 0, :3].tolist() == [102, 102, 102]


def test_all_files_there_is_the_headline() -> None:
    assert "All files are there: 1" in page(replace(ALL, files=ALL.files[2:])).text


def test_names_are_text_and_nothing_is_loaded() -> None:
    hostile = JUDGED._replace(worst=HOSTILE)
    files = (EMPTY._replace(reason=HOSTILE), ALL.files[2]._replace(judged=hostile))
    found = page(replace(ALL, name=HOSTILE, content=HOSTILE, views=HOSTILE, files=files))
    assert not found.named("script")
    assert {str(each["src"])[:5] for each in found.named("img")} == {"data:"}
    assert {str(each["href"])[0] for each in found.named("a")} == {"#"}
    assert "default-src 'none'" in str(found.named("meta"))
