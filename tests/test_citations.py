"""What docstrings and comments cite is in the repository: pages, their headings, schemas.

A citation is a path from the repository's root, with a heading in quotes behind it where one is meant:
docs/formats/atlas.md, "Octahedral maps".
"""

from __future__ import annotations

import re
from pathlib import Path

from tests.conftest import REPOSITORY
from tests.support.pages import headings

FILES = [
    path
    for folder in ("nerfbake", "benchmarks", "schemas", "engines", "tests")
    for path in sorted((REPOSITORY / folder).rglob("*"))
    if re.fullmatch(r"[^.]+\.(py|glsl|hlsl|wgsl|cs|proto|fbs|capnp)", path.name) and path != Path(__file__)
]
CITED = re.compile(
    r'\b((?:docs|schemas|tests|benchmarks|nerfbake)/[\w/.-]+\.(?:md|proto|fbs|capnp|py|glsl))(?:,\s"([^"]+)")?'
)


def words_of(text: str) -> str:
    """The text with comment signs and line breaks as single spaces: a citation may go over the end of a line."""
    return re.sub(r"\s+(?:(?://|#)\s+)?", " ", text)


def broken_citations(text: str) -> list[str]:
    found = []
    for path, heading in CITED.findall(words_of(text)):
        page = REPOSITORY / path
        if not page.exists() or (heading and heading not in headings(page)):
            found.append(f'{path}, "{heading}"' if heading else path)
    return found


def test_what_is_cited_is_there() -> None:
    broken = {path.name: found for path in FILES if (found := broken_citations(path.read_text()))}
    assert broken == {}


def test_no_page_outside_the_repository_is_cited() -> None:
    outside = [path.name for path in FILES if re.search(r"(?<!github\.com/)\bspec/\w", path.read_text())]
    assert outside == []


def test_whoever_meets_the_report_finds_out_what_it_is() -> None:
    texts = {path.name: path.read_text() for path in FILES}
    assert [name for name, text in texts.items() if "TR-24-01" in text and "docs/sources.md" not in text] == []


def test_citations_are_found_and_followed() -> None:
    cited = 'Source: docs/formats/atlas.md,\n    "Octahedral maps"; docs/gone.md; docs/conventions.md, "Gone".'
    assert broken_citations(cited) == ["docs/gone.md", 'docs/conventions.md, "Gone"']
    assert sum(len(CITED.findall(words_of(path.read_text()))) for path in FILES) > 20
