"""Read Markdown pages: their text without code, their headings, and the anchors of the headings."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path


def without_code(text: str) -> str:
    """Remove fenced code blocks and indented lines, in which # and [] have other meanings."""
    return re.sub(r"^```.*?^```|^ {4}[^|\n]*$", "", text, flags=re.MULTILINE | re.DOTALL)


@cache
def headings(page: Path) -> list[str]:
    """The texts of a page's headings, in order."""
    return re.findall(r"^#+ (.+)$", without_code(page.read_text()), re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The anchors of the headings, as GitHub and others derive them. Fails if two are the same."""
    slugs = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(page)]
    assert len(set(slugs)) == len(slugs), f"{page.name} has two headings of one name"
    return set(slugs)


def broken_links(page: Path) -> list[str]:
    """The links to files or headings that do not exist."""
    found = []
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", without_code(page.read_text())):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(link)
    return found
