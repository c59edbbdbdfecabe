"""The README, the pages of docs/ and the schemas' pages: every block runs as it stands, every link leads somewhere.

Blocks marked `sh`, `python` and `make` are run; a `make` block is the Makefile of those after it. What is indented
needs scenes or programs that not everybody has, and is not run. Each command of the README is a process, as readers
start it. Those of all other pages run in one process, which loads each kernel once.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile

import pytest

from nerfbake import catalog
from nerfbake.errors import BudgetMissed, InvalidFile, NerfbakeError, OutputError, PipeClosed, UsageError
from tests.conftest import REPOSITORY
from tests.support.one_process import OneProcess
from tests.support.pages import broken_links

README = REPOSITORY / "README.md"
SHADERS = REPOSITORY / "nerfbake" / "shaders" / "README.md"
PAGES = [README, SHADERS, *(page for name in ("docs", "schemas") for page in sorted((REPOSITORY / name).rglob("*.md")))]
LINKED = [*PAGES, REPOSITORY / "CONTRIBUTING.md", REPOSITORY / "CHANGELOG.md", REPOSITORY / "SECURITY.md"]
PROGRAMS = Path(sys.executable).parent
BLOCK = re.compile(r"^```(sh|python|make)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def name_of(page: Path) -> str:
    return str(page.relative_to(REPOSITORY))


def run(language: str, text: str, folder: Path, *, programs: Path = PROGRAMS) -> tuple[int, str]:
    """Run a block with the `nerfbake` in a folder of programs. Returns the exit code, and what it wrote to stderr."""
    path = os.pathsep.join([str(programs), str(PROGRAMS), os.environ["PATH"]])
    command = [sys.executable, "-c", text] if language == "python" else ["bash", "-euo", "pipefail", "-c", text]
    with TemporaryFile() as errors:
        code = subprocess.call(
            command,
            cwd=folder,
            env=os.environ | {"PATH": path},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
        )
        errors.seek(0)
        return code, errors.read().decode()


@pytest.fixture(scope="module")
def one_process() -> Iterator[Path]:
    """A folder with a `nerfbake` whose commands run in one process."""
    process = OneProcess(REPOSITORY)
    yield process.path
    process.close()


# A reader may start at any page: each has a folder of its own, and its blocks follow one another there.
@pytest.mark.long
@pytest.mark.parametrize("page", [page for page in PAGES if BLOCK.search(page.read_text())], ids=name_of)
def test_the_blocks_of_a_page_run_in_their_order(page: Path, one_process: Path, tmp_path: Path) -> None:
    programs = PROGRAMS if page == README else one_process
    for language, text in BLOCK.findall(page.read_text()):
        if language == "make":
            (tmp_path / "Makefile").write_text(text)
            continue
        code, errors = run(language, text, tmp_path, programs=programs)
        assert code == 0, f"{text}\n{errors}"


def test_a_block_that_fails_fails_the_test(one_process: Path, tmp_path: Path) -> None:
    assert run("sh", "false | true\n", tmp_path) == (1, "")
    assert run("python", "raise SystemExit(3)\n", tmp_path) == (3, "")
    code, errors = run("sh", "nerfbake info gone.npz | cat\n", tmp_path, programs=one_process)
    assert (code, "gone.npz" in errors) == (1, True)
    assert run("sh", "nerfbake info --no-such-option\ntouch ran\n", tmp_path, programs=one_process)[0] == 2
    assert not (tmp_path / "ran").exists()


def test_commands_of_one_process_have_their_own_folder_and_streams(one_process: Path, tmp_path: Path) -> None:
    made = "nerfbake sample octree - --to npz --resolution 8 | nerfbake svo - - --to svo.pb >a.svo.pb"
    assert run("sh", f"{made}; mkdir b; cd b; nerfbake info ../a.svo.pb >c\n", tmp_path, programs=one_process)[0] == 0
    assert "8 x 8 x 8" in (tmp_path / "b" / "c").read_text()


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
