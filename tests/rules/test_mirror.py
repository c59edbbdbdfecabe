"""The folders of tests mirror those of the package, and every module is imported by a test or close to one."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from nerfbake import catalog
from tests.conftest import REPOSITORY
from tests.support.source import PACKAGE, modules, parsed, public_names

TESTS = REPOSITORY / "tests"
# Folders that mirror no package: frozen and hostile files of every format, end-to-end runs, rules, and helpers.
ABOUT_ALL = {"conformance", "end_to_end", "fuzz", "rules", "support"}
# Test files about several modules, commands, formats or shaders, or about what is no module. Add none without a reason.
ABOUT_SEVERAL = {
    ".": {"citations", "contributing", "readme", "wheel"},
    "cli": {"folders", "help", "hostile_names", "jobs", "json_schemas", "pipes", "usd"},
    "formats/camera": {"tool_traps", "tools", "tools_data", "tools_hostile"},
    "formats/mesh": {"blender", "khronos"},
    "formats/octree": {"formats"},
    "formats/variants": {"usd"},
    "formats/volume": {"usd"},
    "formats/wire": {"damaged_streams"},
    "formats/wire/usd": {"damage", "writers"},
    "jobs": {"examples", "scenery"},
    "shaders": {"conformance", "scripts", "three", "three_splats", "together"},
}
LAYERS = ("kernels", "scene", "stages", "formats")

MODULES = {".".join(path.relative_to(REPOSITORY).with_suffix("").parts): path for path in modules()}
PUBLIC = public_names()  # where each public name is defined


@cache
def imported(path: Path) -> set[str]:
    """The modules of LAYERS that a file imports: the module, a name in it, or a public name that it defines."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
            found |= {PUBLIC.get(alias.name, "") for alias in node.names if node.module == "nerfbake"}
    return {name for name in found & MODULES.keys() if name.split(".")[1] in LAYERS}


def with_helpers(names: Iterable[str]) -> set[str]:
    """These modules, and the modules of the same package that they import, directly or indirectly."""
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


def test_a_test_file_is_named_after_a_module_and_what_it_tests_of_it() -> None:
    """test_camera.py and test_camera_lens.py are about camera.py or _camera.py in the folder that theirs mirrors."""
    wrong = []
    for path in TESTS.rglob("test_*.py"):
        folder = path.parent.relative_to(TESTS)
        if folder.parts[:1] and folder.parts[0] in {*ABOUT_ALL, "engines", "examples"}:
            continue
        homes = [home / folder for home in (PACKAGE, REPOSITORY) if (home / folder).is_dir()]
        deep = folder.parts == ("shaders",)  # a folder for each language
        named = {each.stem.lstrip("_") for home in homes for each in (home.rglob("*") if deep else home.iterdir())}
        words = path.stem.removeprefix("test_").split("_")
        if not named.intersection("_".join(words[:count]) for count in range(1, len(words) + 1)):
            wrong.append((folder.as_posix(), "_".join(words)))
    assert sorted(wrong) == sorted((folder, name) for folder, names in ABOUT_SEVERAL.items() for name in names)


def test_a_module_is_imported_by_a_test_or_by_a_module_that_a_test_imports() -> None:
    """Helpers count with the modules of their package that import them. Formats always count: each has frozen files."""
    formats = {f"nerfbake.formats.{form.module}" for form in catalog.FORMATS + catalog.FOLDERS + catalog.DIALECTS}
    near = with_helpers(formats.union(*map(imported, TESTS.rglob("*.py"))))
    one_further = near.union(*(imported(MODULES[name]) for name in near))
    assert {name for name in MODULES if name.split(".")[1] in LAYERS} - one_further == set()
