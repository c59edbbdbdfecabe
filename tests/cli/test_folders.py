"""Commands that write folders: nothing is lost that they did not write, whatever OUT is, with and without --force."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from nerfbake.cli import main
from nerfbake.cli.main import run
from nerfbake.cli.paths import Stage1AndFolder, Writes
from nerfbake.errors import OutputError
from nerfbake.jobs import bake_mesh, bake_splats, refit_file
from nerfbake.jobs.files import FolderTarget
from nerfbake.jobs.shaders import CONTENTS
from tests.conftest import REPOSITORY
from tests.support.videos import write_video

LOADED = bake_mesh, bake_splats, refit_file  # before EDGE changes, the default of their options
# Each command that replaces a folder as a whole, with IN, OUT and options that make it quick.
REPLACE = {
    "atlas": "atlas {stage1} {out} --clusters 4 --map-size 8 --directions 8",
    "frames": "frames {video} {out} --count 2",
    "lattice": "lattice {tree} {out} --rounds 1",
    "mesh": "mesh {tree} {out} --frames 2 --edge 8 --triangles 20 --texture 16",
    "sample nerf2mesh": "sample nerf2mesh {out} --resolution 16",
    "ship": "ship {tree} {out} --for unity",
    "shaders": "shaders {out} --language hlsl --what world",
}
ADD = {"render", "sample capture"}  # these add files to a folder, and replace only files of the same names
every_writer = pytest.mark.parametrize("command", REPLACE)


def commands(group: click.Group = main.cli, above: str = "") -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, f"{above}{name} ")
        else:
            yield above + name, command


def test_every_command_that_writes_a_folder_is_in_this_list() -> None:
    found = {
        name
        for name, command in commands()
        for param in command.params
        if isinstance(param.type, Writes | Stage1AndFolder) and "OUT_DIR" in str(param.metavar)
    }
    assert found | {"mesh", "render"} == REPLACE.keys() | ADD
    words = re.compile(r"\b(FolderTarget|replacing_folder|save_files|save_folder|saving_folder)\b")
    jobs = {path.stem for path in (REPOSITORY / "nerfbake/jobs").glob("*.py") if words.search(path.read_text())}
    known = {"atlases", "budgets", "cameras", "files", "lattices", "meshes", "poses", "samples", "shaders", "shipments"}
    known |= {"fit_state", "frames", "splats"}  # levels of splats
    assert jobs == known


@pytest.fixture
def place(tmp_path: Path, tree_file: Path, sample: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the inputs in a subfolder, which is the working folder, and an empty home folder."""
    work = tmp_path / "work"
    work.mkdir()
    tree_file.rename(work / "a.npz")
    (work / "thesis.tex").write_text("precious")
    write_video(work / "a.mkv", [np.full((16, 16, 3), 0.5)] * 4)
    (work / "stage1").mkdir()
    for file in (sample / "in").iterdir():
        (work / "stage1" / file.name).hardlink_to(file)
    (tmp_path / "home").mkdir()
    (tmp_path / "link").symlink_to("work")
    monkeypatch.setattr("nerfbake.jobs.readings._EDGE", 8)  # of the pictures on which they are measured
    import_module("nerfbake.jobs.shipments")  # whose defaults are made of it
    monkeypatch.setattr("nerfbake.jobs.budgets.EDGE", 8)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(work)
    return tmp_path


def line(command: str, out: str, *more: str) -> list[str]:
    return [*REPLACE[command].format(tree="a.npz", stage1="stage1", video="a.mkv", out=out).split(), *more, "-q"]


def contents(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@every_writer
def test_the_working_folder_the_home_folder_and_those_around_them_are_never_replaced(
    command: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(place)
    outs = {
        ".": "is the working folder",
        "./": "is the working folder",
        "../work": "is the working folder",
        "../work//": "is the working folder",
        "stage1/..": "is the working folder",
        str(place / "link"): "is the working folder",
        str(place / "link" / "."): "is the working folder",
        "../home": "is the home folder",
        "..": "contains the working folder",
        "/": "contains the working folder",
    }
    for out, said in outs.items():
        for force in ([], ["--force"]):
            assert run(line(command, out, *force)) == OutputError.exit_code
            message = capsys.readouterr().err
            assert said in message
            assert "--force" not in message
    assert contents(place) == before


@every_writer
def test_the_working_folder_is_not_replaced_even_if_it_is_empty(
    command: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "empty").mkdir()
    monkeypatch.chdir(place / "empty")
    words = [word.replace("a.npz", "../work/a.npz").replace("stage1", "../work/stage1") for word in line(command, ".")]
    assert run(words) == OutputError.exit_code
    assert "is the working folder" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["atlas", "lattice", "mesh"])
def test_a_folder_that_is_or_contains_an_input_is_never_replaced(
    command: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "in").mkdir()
    (place / "in" / "stage1").mkdir()
    for file in (place / "work" / "stage1").iterdir():
        file.rename(place / "in" / "stage1" / file.name)
    (place / "work" / "a.npz").rename(place / "in" / "stage1" / "a.npz")
    (place / "to_in").symlink_to("in")
    before = contents(place)
    for tree in ("../in/stage1/a.npz", "../to_in/stage1/a.npz"):
        for out in ("../in", "../in/stage1", "../to_in", "../to_in/stage1/", "../in/stage1/../stage1"):
            words = REPLACE[command].format(tree=tree, stage1=str(Path(tree).parent), out=out).split()
            assert run([*words, "--force", "-q"]) == OutputError.exit_code
            assert " the input ../" in capsys.readouterr().err
    assert contents(place) == before


def test_inputs_of_options_count_too(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("stage1").rename("../out")
    (place / "cams").mkdir()
    (place / "cams" / "transforms.json").write_text("{}")
    before = contents(place)
    for words, said in (
        ("atlas ../out --feature ../out/feat1_0.png --mlp ../out/mlp.json", "contains the input ../out/feat1_0.png"),
        ("mesh a.npz ../out --views ../out", "is the input ../out"),
        ("mesh a.npz ../cams --views ../cams/transforms.json", "contains the input ../cams/transforms.json"),
        ("atlas ../out ../cams --min-psnr 9 --cameras ../cams", "is the input ../cams"),
        ("lattice a.npz ../cams --min-psnr 9 --cameras ../cams", "is the input ../cams"),
    ):
        assert run([*words.split(), "--force"]) == OutputError.exit_code
        assert said in capsys.readouterr().err
    (place / "out").rename(place / "b.rejected")  # this would be replaced if the limit is missed
    assert run(["atlas", "../b.rejected", "../b", "--min-psnr", "99", "--force"]) == OutputError.exit_code
    assert "../b.rejected: is the input ../b.rejected" in capsys.readouterr().err
    (place / "b.rejected").rename(place / "out")
    assert contents(place) == before


@pytest.mark.parametrize(
    "command", [pytest.param(command, marks=pytest.mark.long if command == "lattice" else ()) for command in REPLACE]
)
def test_a_folder_with_anything_else_is_never_replaced(
    command: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each kind of entry that nerfbake does not write: a file, a link, a pipe, an empty folder, a folder of files."""
    out = place / "out"
    maker = "sample nerf2mesh" if command == "mesh" else command  # the same kind of folder, in a tenth of the time
    assert run(line(maker, str(out))) == 0
    capsys.readouterr()
    own = contents(out)
    some = next(iter(own))
    entries: dict[str, Any] = {
        "thesis.tex": lambda path: path.write_text("precious"),
        ".hidden": lambda path: path.write_text("precious"),
        "a link": lambda path: path.symlink_to(out / some),
        "pipe": os.mkfifo,
        "empty": Path.mkdir,
        "photographs": lambda path: (path.mkdir(), (path / some).write_bytes(b"")),
    }
    for name, make in entries.items():
        make(out / name)
        assert run(line(command, str(out), "--force")) == OutputError.exit_code
        message = capsys.readouterr().err
        assert f"'{name}" in message
        assert "nerfbake did not write; allowed: a new or empty folder" in message
        assert run(line(command, str(out))) == OutputError.exit_code
        assert "--force" not in capsys.readouterr().err  # it would not help
        if name == "photographs":
            (out / name / some).unlink()
        (out / name).rmdir() if (out / name).is_dir() else (out / name).unlink()
    (out / some).rename(out / "aside")
    (out / some).symlink_to("aside")
    assert run(line(command, str(out), "--force")) == OutputError.exit_code
    (out / "aside").replace(out / some)
    assert contents(out) == own
    capsys.readouterr()
    assert run(line(command, str(out))) == OutputError.exit_code
    assert "exists already; allowed: a new or empty folder, or --force" in capsys.readouterr().err
    assert run(line(maker, str(out), "--force")) == 0
    assert contents(out).keys() == own.keys()
    assert sorted(path.name for path in place.iterdir()) == ["home", "link", "out", "work"]


@pytest.mark.slow
@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    ("command", "variants"),
    [
        ("atlas stage1 ../out --map-size 4 --directions 8 --in-up z", ["--method grid --nodes 2", "--method affine"]),
        ("lattice a.npz ../out --rounds 1", ["--merged", ""]),
        ("shaders ../out", [""]),
        ("sample nerf2mesh ../out --resolution 16", ["--seed 1"]),
    ],
)
def test_a_folder_with_any_variant_of_its_kind_is_replaced(command: str, variants: list[str]) -> None:
    """Whatever a command writes is known to be its own."""
    for variant in [*variants, variants[0]]:
        assert run([*command.split(), *variant.split(), "--force", "-q"]) == 0


def test_a_folder_of_another_kind_is_not_replaced(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for names in (["mesh_0.obj", "mesh_0.mtl"], ["README.md"], ["transforms.json"], ["scene.glb"]):
        out = place / "out"
        out.mkdir()
        for name in names:
            (out / name).write_text("# My project\n")
        for command in REPLACE:
            assert run(line(command, str(out), "--force")) == OutputError.exit_code
            assert "; allowed: a new or empty folder, or one with nothing but " in capsys.readouterr().err
        assert [path.read_text() for path in out.iterdir()] == ["# My project\n"] * len(names)
        for name in names:
            (out / name).unlink()
        out.rmdir()


def test_a_rejected_folder_is_replaced_by_the_same_rules(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "out.rejected").mkdir()
    (place / "out.rejected" / "mine").touch()
    words = line("atlas", "../out", "--min-psnr", "99", "--force")
    assert run(words) == OutputError.exit_code
    assert "../out.rejected: has 'mine', which nerfbake did not write" in capsys.readouterr().err
    (place / "out.rejected" / "mine").unlink()
    for _ in range(2):  # the second one replaces the first
        assert run(words) == 3
        assert "atlas.json" in contents(place / "out.rejected")
    assert sorted(path.name for path in place.iterdir()) == ["home", "link", "out.rejected", "work"]


def test_an_empty_folder_and_a_link_to_one_are_filled(place: Path) -> None:
    (place / "real").mkdir(0o700)
    (place / "to_real").symlink_to("real")
    assert run(line("shaders", "../to_real")) == 0
    assert sorted(contents(place / "real")) == ["README.md", "hlsl/world.hlsl"]
    assert (place / "to_real").is_symlink()
    assert (place / "real").stat().st_mode & 0o777 == 0o700


def test_a_state_does_not_replace_a_plan_of_somebody_else(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("plan.txt").write_text("Monday: write the thesis\n")
    assert run(["batch", "info {in}", "a.npz", "--state", "."]) == OutputError.exit_code
    assert "plan.txt: is not the plan of a batch" in capsys.readouterr().err
    assert Path("plan.txt").read_text() == "Monday: write the thesis\n"


def test_a_folder_that_is_gone_as_working_folder_is_no_bug(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "gone").mkdir()
    monkeypatch.chdir(place / "gone")
    (place / "gone").rmdir()
    FolderTarget(str(place / "out")).require(CONTENTS)
