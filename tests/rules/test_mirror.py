"""Tests stand where what they test stands, and no module stands far from a test."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from nerfbake import catalog
from tests.conftest import REPOSITORY
from tests.support.source import PACKAGE, modules

TESTS = REPOSITORY / "tests"
# About no one package: frozen and hostile files of every format, whole runs, the rules that all follow, and helpers.
ABOUT_ALL = {"conformance", "end_to_end", "fuzz", "rules", "support"}
LAYERS = ("kernels", "scene", "stages", "formats")

MODULES = {".".join(path.relative_to(REPOSITORY).with_suffix("").parts): path for path in modules()}
PUBLIC = catalog.STAGES | catalog.SCENES  # names of the public API: where they are


@cache
def imported(path: Path) -> set[str]:
    """Modules of LAYERS that a file imports: as such, for what is in them, or by a public name."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
            found |= {PUBLIC.get(alias.name, "") for alias in node.names if node.module == "nerfbake"}
    return {name for name in found & MODULES.keys() if name.split(".")[1] in LAYERS}


def with_helpers(names: Iterable[str]) -> set[str]:
    """These modules and what each imports from its own package, directly or not."""
    found = set(names)
    waiting = list(found)
    while waiting:
        name = waiting.pop()
        own = {other for other in imported(MODULES[name]) if package_of(other) == package_of(name)}
        waiting += own - found
        found |= own
    return found


def package_of(name: str) -> str:
    return name.rpartition(".")[0]


def test_every_folder_of_tests_mirrors_a_folder_and_every_package_has_one() -> None:
    tested = {path.parent.relative_to(TESTS) for path in TESTS.rglob("test_*.py")} - {Path()}
    mirrors = {folder for folder in tested if folder.parts[0] not in ABOUT_ALL}
    assert [folder for folder in mirrors if not any((home / folder).is_dir() for home in (PACKAGE, REPOSITORY))] == []
    packages = {path.parent.relative_to(PACKAGE) for path in MODULES.values()} - {Path()}
    assert packages - mirrors == set()


def test_a_module_is_imported_by_a_test_or_by_a_module_that_a_test_imports() -> None:
    """Helpers within a package count as the modules that they help; formats as imported: each has frozen files."""
    formats = {f"nerfbake.formats.{form.module}" for form in catalog.FORMATS + catalog.FOLDERS}
    near = with_helpers(formats.union(*map(imported, TESTS.rglob("*.py"))))
    one_further = near.union(*(imported(MODULES[name]) for name in near))
    assert {name for name in MODULES if name.split(".")[1] in LAYERS} - one_further == set()
