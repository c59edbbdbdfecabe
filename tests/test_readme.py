"""The README, the pages of docs/ and the schemas' pages: every block runs as it stands, every link leads somewhere.

Blocks marked `sh`, `python` and `make` are run; a `make` block is the Makefile of those after it. What is indented
needs scenes or programs that not everybody has, and is not run.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from itertools import chain
from pathlib import Path

import pytest

from nerfbake import catalog
from nerfbake.errors import BudgetMissed, InvalidFile, NerfbakeError, OutputError, PipeClosed, UsageError
from tests.conftest import REPOSITORY
from tests.support.pages import broken_links

README = REPOSITORY / "README.md"
SHADERS = REPOSITORY / "nerfbake" / "shaders" / "README.md"
PAGES = [README, SHADERS, *(page for name in ("docs", "schemas") for page in sorted((REPOSITORY / name).rglob("*.md")))]
LINKED = [*PAGES, REPOSITORY / "CONTRIBUTING.md", REPOSITORY / "CHANGELOG.md", REPOSITORY / "SECURITY.md"]
BLOCK = re.compile(r"^```(sh|python|make)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def name_of(page: Path) -> str:
    return str(page.relative_to(REPOSITORY))


def run(language: str, text: str, folder: Path) -> subprocess.CompletedProcess[bytes]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = [sys.executable, "-c", text] if language == "python" else ["bash", "-euo", "pipefail", "-c", text]
    return subprocess.run(command, cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, check=False)


# A reader may start at any page: each has a folder of its own, and its blocks follow one another there.
@pytest.mark.long
@pytest.mark.parametrize("page", [page for page in PAGES if BLOCK.search(page.read_text())], ids=name_of)
def test_the_blocks_of_a_page_run_in_their_order(page: Path, tmp_path: Path) -> None:
    for language, text in BLOCK.findall(page.read_text()):
        if language == "make":
            (tmp_path / "Makefile").write_text(text)
            continue
        done = run(language, text, tmp_path)
        assert done.returncode == 0, f"{text}\n{done.stderr.decode()}"


def test_a_block_that_fails_fails_the_test(tmp_path: Path) -> None:
    assert run("sh", "false | true\n", tmp_path).returncode == 1
    assert run("python", "raise SystemExit(3)\n", tmp_path).returncode == 3


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_links_that_lead_nowhere_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A `name`, and more\n[a](page.md) [b](#a-name-and-more) [c](gone.md) [d](page.md#gone)\n")
    assert broken_links(page) == ["gone.md", "page.md#gone"]


def test_every_page_is_in_the_index() -> None:
    index = (REPOSITORY / "docs" / "README.md").read_text()
    for page in (REPOSITORY / "docs").rglob("*.md"):
        name = str(page.relative_to(REPOSITORY / "docs"))
        assert name == "README.md" or f"]({name})" in index, name


def test_the_readme_can_be_finished() -> None:
    assert len(README.read_text().splitlines()) <= 150


def test_every_make_target_that_is_named_is_there() -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    targets = set(
        chain.from_iterable(
            re.findall(r"(?:`|^    )make ([a-z][a-z-]+)", page.read_text(), re.MULTILINE) for page in PAGES
        )
    )
    assert {"demo", "test", "test-cpus", "fuzz"} <= targets
    for target in targets - {"octrees"}:  # the recipe's own
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_ci_calls_the_test_command() -> None:
    assert (REPOSITORY / ".ci" / "run").read_text().splitlines()[-2:] == ["make test", "make test-rest"]
    assert "    make test " in README.read_text()


def test_every_ending_is_told() -> None:
    rows = [line for line in README.read_text().splitlines() if line.startswith("| `.")]
    told = set(re.findall(r"`([^`]+)`", " ".join(row.split("|")[1] for row in rows)))
    assert told == {form.suffix for form in catalog.FORMATS}


def test_every_exit_code_is_told() -> None:
    told = (REPOSITORY / "docs" / "scripts.md").read_text()
    for error in (NerfbakeError, InvalidFile, UsageError, BudgetMissed, OutputError):
        assert f"| {error.exit_code} |" in told
    assert f" {PipeClosed.exit_code}," in told
