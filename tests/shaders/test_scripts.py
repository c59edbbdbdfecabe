"""The scripts of a page, read by TypeScript's compiler and by ESLint; `make tools` installs both, for tests alone."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

pytestmark = pytest.mark.tools
HERE, SCRIPTS = Path(__file__).parent / "scripts", REPOSITORY / "nerfbake" / "shaders" / "page"
TSC, ESLINT = (HERE / "node_modules" / place for place in ("typescript/bin/tsc", "eslint/bin/eslint.js"))


@pytest.fixture(autouse=True)
def installed() -> None:
    if shutil.which("node") is None or not TSC.exists() or not ESLINT.exists():
        pytest.skip("no TypeScript and no ESLint: `make tools` installs them")


def told(*command: str | Path, cwd: Path) -> str:
    """What a program of Node's finds, on stdout and stderr; '' is nothing."""
    done = subprocess.run(["node", *command], cwd=cwd, capture_output=True, text=True, check=False)
    assert bool(done.returncode) == bool(done.stdout + done.stderr), done.stdout + done.stderr
    return done.stdout + done.stderr


def test_types_fit() -> None:
    assert told(TSC, "--pretty", "false", "--project", HERE, cwd=SCRIPTS) == ""


def test_nothing_is_found_by_the_linter() -> None:
    assert told(ESLINT, "--config", HERE / "eslint.config.mjs", ".", cwd=SCRIPTS) == ""


def test_a_mistake_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.js").write_text("function f(a) {\n  var b = a == 1;\n  return b.length;\n}\nf(new Nothing());\n")
    (tmp_path / "tsconfig.json").write_text(json.dumps({"extends": str(HERE / "tsconfig.json"), "include": ["a.js"]}))
    found = told(TSC, "--pretty", "false", "--project", tmp_path, cwd=tmp_path)
    assert "Property 'length' does not exist on type 'boolean'" in found
    assert "Cannot find name 'Nothing'" in found
    found = told(ESLINT, "--config", HERE / "eslint.config.mjs", ".", cwd=tmp_path)
    assert "no-var" in found
    assert "eqeqeq" in found
