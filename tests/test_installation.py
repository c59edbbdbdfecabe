"""What a plain installation brings, what an extra brings, and what is said where an extra is missing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from nerfbake import save
from nerfbake.bench.access.readers import reading
from nerfbake.bench.environment import EXTRAS
from nerfbake.bench.measure import measure
from nerfbake.cli.main import run
from tests.conftest import REPOSITORY
from tests.support.octrees import small_octree
from tests.support.source import PACKAGE, imports, modules

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]


def names(requirements: list[str]) -> set[str]:
    """The packages of some requirements, spelled as `import` would look them up."""
    return {normal(re.match(r"[\w.-]+", requirement).group()) for requirement in requirements}  # type: ignore[union-attr]


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def imported() -> set[str]:
    """Modules from outside that some file of the package imports."""
    found = {name.partition(".")[0] for path in (*modules(), PACKAGE / "__init__.py") for name in imports(path)}
    return found - set(sys.stdlib_module_names) - {"nerfbake"}


distributions = cache(packages_distributions)  # it reads every installed package's list of files


def packages_of(module: str) -> set[str]:
    return {normal(name) for name in distributions()[module]}


def test_a_plain_installation_brings_every_import_but_those_of_extras() -> None:
    plain = names(PROJECT["dependencies"])
    assert {module for module in imported() if not packages_of(module) & plain} == set(EXTRAS)


def test_no_dependency_is_there_for_nothing() -> None:
    used = set().union(*map(packages_of, imported()))
    assert names(PROJECT["dependencies"]) <= used


def test_each_extra_brings_its_library_and_tests_have_them_all() -> None:
    extras = PROJECT["optional-dependencies"]
    for module, extra in EXTRAS.items():
        assert packages_of(module) & names(extras[extra])
    assert extras["test"][0] == f"nerfbake[{','.join(EXTRAS.values())}]"


def test_a_plot_without_matplotlib_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr("nerfbake.bench.formats.comparison.compare_formats", pytest.fail)
    plot = tmp_path / "a.svg"
    assert run(["bench", "formats", str(tmp_path / "a.svo.pb"), "--plot", str(plot)]) == 2
    said = "--plot needs matplotlib, which is not installed; allowed: pip install 'nerfbake[plot]'"
    assert capsys.readouterr().err == f"error: {said}\n"
    assert not plot.exists()


def test_a_row_whose_library_is_missing_says_which_extra_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The row's own process finds this in the library's place.
    (tmp_path / "warp.py").write_text("raise ModuleNotFoundError('none', name='warp')")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{REPOSITORY}")
    result = measure(reading, name="Warp", folder=str(tmp_path), channels=1, kinds=[], limit=0)
    assert result.error == "not installed: warp; pip install 'nerfbake[warp]'"


def test_no_command_needs_an_extra_to_say_what_it_does() -> None:
    code = f"""if True:
        import sys
        sys.modules.update(dict.fromkeys({sorted(EXTRAS)!r}))
        from importlib import import_module
        from nerfbake.cli.main import run
        for name in {sorted(path.stem for path in modules() if path.parent.name == "bench" and path.stem[0] != "_")!r}:
            import_module(f"nerfbake.bench.{{name}}")
        sys.exit(run(["bench", "--help"]))"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
