"""The recipes of the README and of docs/, run as they stand."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nerfbake import catalog
from nerfbake.errors import BudgetMissed, InvalidFile, NerfbakeError, OutputError, PipeClosed, UsageError
from tests.conftest import REPOSITORY

README = (REPOSITORY / "README.md").read_text()
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]


def blocks(language: str) -> list[str]:
    text = "\n".join(page.read_text() for page in PAGES)
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recipes")


def bash(script: str, folder: Path) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = ["bash", "-euo", "pipefail", "-c", script]
    done = subprocess.run(command, cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


# In the README's order, in one folder, as a reader would paste them.
@pytest.mark.parametrize("script", blocks("sh"), ids=lambda script: script.splitlines()[0])
def test_shell_recipes_run(script: str, folder: Path) -> None:
    bash(script, folder)


@pytest.mark.parametrize("script", blocks("python"))
def test_python_recipes_run(script: str, folder: Path) -> None:
    done = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize("rules", blocks("make"))
def test_make_recipes_run(rules: str, folder: Path) -> None:
    (folder / "Makefile").write_text(rules)
    (folder / "chair.svo.pb").unlink(missing_ok=True)
    bash("make octrees && test -s chair.svo.pb && make octrees | grep 'Nothing to be done'", folder)


def test_every_make_target_that_is_named_is_there() -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    text = "\n".join(page.read_text() for page in PAGES)
    targets = re.findall(r"(?:`|^    )make ([a-z-]+)", text, re.MULTILINE)
    assert {"demo", "test", "test-cpus", "fuzz"} <= set(targets)
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_ci_calls_the_test_command() -> None:
    assert (REPOSITORY / ".ci" / "run").read_text().splitlines()[-2:] == ["make test", "make test-slow"]
    assert "    make test " in README


def test_every_ending_and_exit_code_is_told() -> None:
    for form in catalog.FORMATS:
        assert f"| `{form.suffix}` |" in README
    for error in (NerfbakeError, InvalidFile, UsageError, BudgetMissed, OutputError):
        assert f"| {error.exit_code} |" in README
    assert f" {PipeClosed.exit_code}," in README


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for link in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text()):
            assert (page.parent / link).exists(), (page.name, link)
