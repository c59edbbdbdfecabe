"""What CONTRIBUTING names is there, and the table of who may import whom has everybody in it."""

from __future__ import annotations

import re

from tests.conftest import REPOSITORY
from tests.rules.test_imports import RULES

TEXT = (REPOSITORY / "CONTRIBUTING.md").read_text()
MAKEFILE = (REPOSITORY / "Makefile").read_text()


def test_every_file_that_contributing_names_is_there() -> None:
    named = re.findall(r"(?:nerfbake|tests|schemas|benchmarks|docs)/[\w/.]*\w/?", TEXT)
    named += re.findall(r"`([\w.]+\.(?:md|toml))`", TEXT)
    assert {"nerfbake/contract.py", "tests/support/scenes.py", "schemas/conformance", "README.md"} <= set(named)
    for path in named:  # of nerfbake/cli/<name>.py the folder
        assert (REPOSITORY / path).exists(), path


def test_every_make_target_that_contributing_names_is_there() -> None:
    targets = re.findall(r"\bmake ([a-z][a-z-]+)", "\n".join(re.findall(r"`[^`]+`|^    .*", TEXT, re.MULTILINE)))
    assert {"setup", "test", "test-quick", "lint", "golden"} <= set(targets)
    for target in targets:
        assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), target


def test_every_layer_of_the_house_stands_in_its_table() -> None:
    rows = "\n".join(line.split("|")[1] for line in TEXT.splitlines() if line.startswith("|"))
    for layer in RULES:
        assert re.search(rf"`{layer}(\.py`|/)", rows), layer
        assert (REPOSITORY / "nerfbake" / layer).exists() or (REPOSITORY / "nerfbake" / f"{layer}.py").exists()


def test_contributing_is_read_in_one_sitting() -> None:
    assert len(TEXT.splitlines()) <= 150
