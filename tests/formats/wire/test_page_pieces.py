"""Pieces of pages: whatever is put into them is text."""

from __future__ import annotations

from nerfbake.formats.wire.page import END, beginning, figure, picture, table, text


def test_whatever_is_put_into_a_page_is_text() -> None:
    assert text('<b>&"\n\x1b[2J') == "&lt;b&gt;&amp;&quot; [2J"
    assert len(text("x" * 10_000)) <= 300


def test_a_page_forbids_scripts_and_requests() -> None:
    page = beginning("Title") + END
    assert "<title>Title</title>" in page
    assert "default-src 'none'; img-src data:" in page
    assert "base-uri 'none'; form-action 'none'" in page
    assert "<script" not in page
    assert page.endswith("</html>\n")


def test_figures_are_rounded_for_people_and_whole_for_programs() -> None:
    assert figure(1 / 3, ".2f") == '<data value="0.3333333333333333">0.33</data>'


def test_a_table_has_heads_of_columns_and_rows() -> None:
    made = table(["a", "b"], [["1", "2"]])
    assert made.count('<th scope="col">') == 2
    assert '<tr><th scope="row">1</th><td>2</td></tr>' in made


def test_a_picture_is_within_the_page() -> None:
    made = picture(b"png", ' width="2"', "what")
    assert made.startswith('<figure><img src="data:image/png;base64,cG5n" width="2" alt="what">')
