"""Analyse the source code of nerfbake's modules."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from tests.conftest import REPOSITORY

PACKAGE = REPOSITORY / "nerfbake"


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py"))


@cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file, parsed once for all rules. Do not change it."""
    return ast.parse(path.read_text())


def imports(path: Path) -> set[str]:
    """The dotted names of all modules that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {
                f"{node.module}.{alias.name}" if node.module == "nerfbake" else str(node.module) for alias in node.names
            }
    return found


def imports_by_name(path: Path) -> set[str]:
    """The dotted names of nerfbake's modules that a file passes to import_module(): constants, and what f-strings
    begin with. A name that is computed is `*`.
    """
    constants = {
        target.id: node.value
        for node in parsed(path).body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in _IMPORTERS:
            name = node.args[0]
            name = constants.get(name.id, name) if isinstance(name, ast.Name) else name
            name = name.values[0] if isinstance(name, ast.JoinedStr) else name
            text = name.value if isinstance(name, ast.Constant) else "nerfbake."
            found |= {"*" if text == "nerfbake." else str(text).rstrip(".")}
    return found


_IMPORTERS = {"import_module", "__import__"}


@cache
def import_graph() -> dict[Path, set[Path]]:
    """{module: modules of nerfbake that it imports with import statements, also inside functions}.

    Do not change it.
    """
    files = modules()
    return {path: _imported_files(path).intersection(files) for path in files}


def _imported_files(path: Path) -> set[Path]:
    found = set()
    for node in ast.walk(parsed(path)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)]
        found |= {PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names}
    return found


def public_names(package: str = "nerfbake") -> dict[str, str]:
    """{name: module that defines it} for the classes and functions in the stub of a package."""
    stub = PACKAGE.parent.joinpath(*package.split("."), "__init__.pyi")
    return {
        alias.name: f"{package}.{node.module}"
        for node in ast.parse(stub.read_text()).body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


def public_names_of(layer: str) -> dict[str, str]:
    """The public names of a layer: `scene` or `stages`."""
    return {name: home for name, home in public_names().items() if home.startswith(f"nerfbake.{layer}.")}
