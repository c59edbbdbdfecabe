"""The wheel in an empty environment that has the plain dependencies and nothing else."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement
from PIL import Image as Pillow

from nerfbake.installation import EXTRAS
from tests.conftest import REPOSITORY

README = (REPOSITORY / "README.md").read_text()


def dependencies(of: list[str], found: dict[str, Distribution]) -> dict[str, Distribution]:
    """What pip would install for some requirements, from the environment of the tests."""
    for line in of:
        requirement = Requirement(line)
        if requirement.name not in found and (requirement.marker is None or requirement.marker.evaluate({"extra": ""})):
            found[requirement.name] = distribution(requirement.name)
            dependencies(found[requirement.name].requires or [], found)
    return found


def entries(installed: Distribution) -> Iterator[Path]:
    """The files and folders of a package at the top of site-packages."""
    tops = {path.parts[0] for path in installed.files or ()}
    return (Path(str(installed.locate_file(top))) for top in tops - {"..", "__pycache__"})


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder], cwd=REPOSITORY, check=True
    )
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with the wheel and links to its dependencies; the folder of its programs."""
    place = tmp_path_factory.mktemp("empty") / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place], check=True)
    pip: list[str | Path] = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        place / "bin" / "python",
        "--disable-pip-version-check",
    ]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", wheel], check=True)
    packages = next(place.glob("lib/python*/site-packages"))
    metadata = next(packages.glob("nerfbake-*.dist-info/METADATA")).read_text()
    plain = [line for line in re.findall(r"^Requires-Dist: (.*)$", metadata, re.MULTILINE) if "extra ==" not in line]
    assert len(plain) >= 14
    for installed in dependencies(plain, {}).values():
        for entry in entries(installed):
            if not (packages / entry.name).exists():
                (packages / entry.name).symlink_to(entry)
    _copy_kernels(packages / "nerfbake")
    return place / "bin"


def _copy_kernels(package: Path) -> None:
    """Copy the kernels that other tests have compiled: numba asks whether the source has the same time and size."""
    for ours in (REPOSITORY / "nerfbake").rglob("*.nb[ic]"):
        target = package / ours.relative_to(REPOSITORY / "nerfbake")
        target.parent.mkdir(exist_ok=True)
        shutil.copy2(ours, target)
    for source in package.rglob("*.py"):
        shutil.copystat(REPOSITORY / "nerfbake" / source.relative_to(package), source)


def shell(environment: Path, text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    variables["PATH"] = f"{environment}{os.pathsep}{variables['PATH']}"
    command = ["bash", "-euo", "pipefail", "-c", text]
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)


def test_the_wheel_has_the_package_and_its_data_and_nothing_else(wheel: Path) -> None:
    names = ZipFile(wheel).namelist()
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"nerfbake"}
    assert not [name for name in names if "__pycache__" in name]
    packed = {name for name in names if name.startswith("nerfbake/")}
    tracked = subprocess.run(
        ["git", "ls-files", "nerfbake"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert packed == set(tracked.stdout.split())


def test_nothing_of_an_extra_comes_with_the_plain_dependencies(environment: Path, tmp_path: Path) -> None:
    code = f"import importlib.util as u; print([m for m in {[*EXTRAS, 'trimesh', 'scipy']} if u.find_spec(m)])"
    assert shell(environment, f"python -c {shlex.quote(code)}", tmp_path).stdout == "[]\n"


@pytest.mark.long
def test_the_first_commands_of_the_readme_run_without_any_extra(environment: Path, tmp_path: Path) -> None:
    block = next(re.finditer(r"^```sh\n(.*?)^```", README, re.MULTILINE | re.DOTALL))[1]
    done = shell(environment, block, tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "fitted.html").stat().st_size > 10_000


@pytest.mark.long
def test_formats_and_meshes_need_no_extra_either(environment: Path, tmp_path: Path) -> None:
    mesh = next((REPOSITORY / "schemas" / "conformance").rglob("*.obj"))
    text = f"""
    nerfbake sample octree chair.npz --resolution 8
    nerfbake svo chair.npz chair.svo.bson
    nerfbake info chair.svo.bson
    nerfbake info {shlex.quote(str(mesh))}
    nerfbake bench formats chair.svo.bson --rounds 1 --formats pymongo
    """
    done = shell(environment, text, tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^pieces +\d", done.stdout, re.MULTILINE)
    assert "not installed: bson; " in done.stdout


def test_photographs_without_poses_name_the_command_that_adds_pycolmap(environment: Path, tmp_path: Path) -> None:
    for name in "abc":
        Pillow.new("RGB", (16, 16)).save(tmp_path / f"{name}.png")
    done = shell(environment, "nerfbake fit . b.npz", tmp_path)
    assert done.returncode == 2
    assert re.search(r"needs pycolmap, which is not installed; allowed: .* install .*\[poses\]'\n$", done.stderr)
