"""What tests ask of the Markdown pages: their text without code, and what links to their headings are called."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path


def without_code(text: str) -> str:
    """The page without its blocks and its indented lines, in which # and [] mean something else."""
    return re.sub(r"^```.*?^```|^ {4}[^|\n]*$", "", text, flags=re.MULTILINE | re.DOTALL)


@cache
def headings(page: Path) -> list[str]:
    """The texts of a page's headings, in order."""
    return re.findall(r"^#+ (.+)$", without_code(page.read_text()), re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What links to the headings are called, as GitHub and others derive it from the text. No two may be the same."""
    slugs = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(page)]
    assert len(set(slugs)) == len(slugs), f"{page.name} has two headings of one name"
    return set(slugs)


def broken_links(page: Path) -> list[str]:
    """Links to files that are not there, and to headings that no page has."""
    found = []
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", without_code(page.read_text())):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(link)
    return found
