"""What a plain installation brings, what an extra brings, and what is said where an extra is missing."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions
from pathlib import Path

import pytest

from nerfbake import save
from nerfbake.bench.access.readers import reading
from nerfbake.bench.measure import measure
from nerfbake.cli.main import run
from nerfbake.errors import NerfbakeError
from nerfbake.installation import EXTRAS, command_for
from nerfbake.jobs import find_poses
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
    assert {module for module in imported() if not packages_of(module) & plain} == {*EXTRAS, "pi_heif"}


def test_no_dependency_is_there_for_nothing() -> None:
    used = set().union(*map(packages_of, imported()))
    assert names(PROJECT["dependencies"]) <= used


def test_each_extra_brings_its_library_and_tests_have_them_all() -> None:
    extras = PROJECT["optional-dependencies"]
    for module, extra in EXTRAS.items():
        assert packages_of(module) & names(extras[extra])
    assert extras["test"][0] == f"nerfbake[{','.join(dict.fromkeys(EXTRAS.values()))}]"


class Installed:
    """An installation of nerfbake as its metadata tells it."""

    requires = ("numpy>=2.0", "pycolmap>=4.2; extra == 'poses'", 'pillow-heif>=1.8; extra == "heic"')

    def __init__(self, installer: str = "pip", origin: object = None) -> None:
        self._files = {"INSTALLER": f"{installer}\n", "direct_url.json": origin and json.dumps(origin)}

    def read_text(self, name: str) -> object:
        return self._files.get(name)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an active virtual environment `env` and a checkout `nerfbake`."""
    (tmp_path / "nerfbake").mkdir()
    (tmp_path / "env" / "bin").mkdir(parents=True)
    pip = tmp_path / "env" / "bin" / "pip"
    pip.touch(0o755)
    monkeypatch.setenv("PATH", str(pip.parent))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "env"))
    monkeypatch.setattr(sys, "executable", str(pip.with_name("python")))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said(installed: Installed, monkeypatch: pytest.MonkeyPatch, module: str = "pycolmap") -> str:
    monkeypatch.setattr("importlib.metadata.distribution", lambda name: installed)
    return command_for(module)


def test_the_command_is_that_of_the_way_in_which_nerfbake_was_installed(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkout = {"url": (place / "nerfbake").as_uri(), "dir_info": {}}
    editable = checkout | {"dir_info": {"editable": True}}
    wheel = {"url": (place / "nerfbake-0.1.0-py3-none-any.whl").as_uri(), "archive_info": {}}
    commit = {"url": "https://example.org/n.git", "vcs_info": {"vcs": "git", "commit_id": "c0ffee"}}
    archive = {"url": "https://example.org/n.whl", "archive_info": {}}
    (place / "nerfbake-0.1.0-py3-none-any.whl").touch()
    commands = {
        "pip install 'nerfbake[poses]'": Installed(),
        "pip install './nerfbake[poses]'": Installed(origin=checkout),
        "pip install --editable './nerfbake[poses]'": Installed(origin=editable),
        "pip install './nerfbake-0.1.0-py3-none-any.whl[poses]'": Installed(origin=wheel),
        "pip install 'nerfbake[poses] @ git+https://example.org/n.git@c0ffee'": Installed(origin=commit),
        "pip install 'nerfbake[poses] @ https://example.org/n.whl'": Installed(origin=archive),
        f"uv pip install --python {place}/env --editable './nerfbake[poses]'": Installed("uv", editable),
    }
    assert [said(installed, monkeypatch) for installed in commands.values()] == [*commands]
    monkeypatch.chdir(place / "nerfbake")
    assert said(Installed(origin=editable), monkeypatch) == "pip install --editable '.[poses]'"
    assert said(Installed(), monkeypatch, "numpy") == ""


def test_a_checkout_that_is_gone_is_not_named(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = Installed(origin={"url": (place / "gone").as_uri(), "dir_info": {}})
    assert said(gone, monkeypatch) == "pip install 'pycolmap>=4.2'"
    assert said(gone, monkeypatch, "pillow_heif") == "pip install 'pillow-heif>=1.8'"


def test_the_pip_is_that_of_the_interpreter(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")  # the environment is not active
    assert said(Installed(), monkeypatch) == "env/bin/python -m pip install 'nerfbake[poses]'"
    monkeypatch.chdir("/")
    assert said(Installed(), monkeypatch) == f"{place}/env/bin/python -m pip install 'nerfbake[poses]'"


def test_pipx_has_a_command_of_its_own(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "env" / "pipx_metadata.json").touch()
    assert said(Installed(), monkeypatch) == "pipx inject nerfbake 'pycolmap>=4.2'"


def test_a_checkout_that_nobody_installed_is_named(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(name: str) -> None:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.distribution", none)
    assert command_for("warp") == f"pip install --editable '{REPOSITORY}[warp]'"


def test_poses_without_pycolmap_name_the_command(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.distribution", lambda name: Installed())
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for name in "abc":
        (place / f"{name}.jpg").touch()
    with pytest.raises(NerfbakeError) as refused:
        find_poses(place)
    expected = "finding poses needs pycolmap, which is not installed; allowed: pip install 'nerfbake[poses]'"
    assert str(refused.value) == expected


def test_a_plot_without_matplotlib_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr("nerfbake.bench.formats.comparison.compare_formats", pytest.fail)
    plot = tmp_path / "a.svg"
    assert run(["bench", "formats", str(tmp_path / "a.svo.pb"), "--plot", str(plot)]) == 2
    told = f"--plot needs matplotlib, which is not installed; allowed: {command_for('matplotlib')}"
    assert capsys.readouterr().err == f"error: {told}\n"
    assert not plot.exists()


def test_a_row_whose_library_is_missing_says_which_extra_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The row's own process finds this in the library's place.
    (tmp_path / "warp.py").write_text("raise ModuleNotFoundError('none', name='warp')")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{REPOSITORY}")
    result = measure(reading, name="Warp", folder=str(tmp_path), channels=1, kinds=[], limit=0)
    assert result.error == f"not installed: warp; {command_for('warp')}"


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


# What Python has on Linux, and not on Windows or macOS.
OTHER_SYSTEMS = """if True:
    import os, signal, sys
    sys.modules.update(dict.fromkeys(["resource", "fcntl", "termios", "pwd", "grp"]))
    for name in "wait4 waitid killpg fork getuid sched_getaffinity sysconf pread statvfs O_NOFOLLOW O_CLOEXEC".split():
        delattr(os, name)
    del signal.SIGKILL
    """


def elsewhere(tmp_path: Path, code: str) -> str:
    """Run code on another system, as far as Python shows it; return what it says to stderr."""
    done = subprocess.run(
        [sys.executable, "-c", OTHER_SYSTEMS + code], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.slow
def test_a_system_without_some_modules_can_import_them_all_and_show_the_help(tmp_path: Path) -> None:
    names = [
        ".".join(("nerfbake", *path.relative_to(PACKAGE).with_suffix("").parts))
        for path in modules()
        if not {"kernels", "stages", "_pycolmap", "warp_reader", "__main__"} & {*path.parts, path.stem}
    ]
    code = f"""
    from importlib import import_module
    from nerfbake.cli.main import run
    assert run(["--help"]) == run(["bench", "--help"]) == run(["batch", "--help"]) == 0
    for name in {names}:
        import_module(name.removesuffix(".__init__"))"""
    assert elsewhere(tmp_path, code) == ""


@pytest.mark.slow
def test_such_a_system_converts_files_and_refuses_a_batch_in_one_line(tmp_path: Path) -> None:
    code = """
    from nerfbake.cli.main import run
    assert run(["sample", "octree", "a.npz", "--resolution", "8", "--quiet"]) == 0
    assert run(["svo", "a.npz", "a.svo.bson", "--quiet"]) == 0
    assert run(["info", "a.svo.bson", "--json"]) == 0
    from nerfbake.bench.environment import environment
    assert "unknown memory" in environment()["machine"]
    assert run(["batch", "info {in}", "a.npz", "--state", "run"]) == 2"""
    told = "a batch needs os.wait4, which linux has not; allowed: Linux or macOS"
    assert elsewhere(tmp_path, code) == f"error: {told}\n"
