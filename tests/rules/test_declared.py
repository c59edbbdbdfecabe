"""Every command declares what it reads and writes, so that a batch can find conflicts before anything runs."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest

from nerfbake.cli import main
from nerfbake.cli.paths import DeclaredPaths, JudgedOutput, Place, Stage1AndFolder, Writes, declared

# Text arguments that are not paths. List a new text option here, or make it a Place.
WORDS = {"basis", "device", "epochs", "fits", "formats", "grids", "scale", "template", "title", "to"}


def commands(group: click.Group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", command


COMMANDS = dict(commands(main.cli))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_path_of_a_command_is_declared(name: str) -> None:
    params = COMMANDS[name].params
    assert any(isinstance(param.type, Place) for param in params)
    for param in params:
        if not isinstance(param.type, Place):
            assert not isinstance(param.type, click.Path), param.name
            assert not isinstance(param.type, click.types.StringParamType) or param.name in WORDS, param.name


@pytest.mark.parametrize("name", COMMANDS)
def test_what_writes_can_be_told_to_replace(name: str) -> None:
    params = COMMANDS[name].params
    if name != "batch" and any(isinstance(param.type, Writes | Stage1AndFolder) for param in params):
        assert "--force" in [option for param in params for option in param.opts]


@pytest.mark.parametrize("name", COMMANDS)
def test_where_a_budget_rejects_an_output_it_is_declared(name: str) -> None:
    told = [param.help or "" for param in COMMANDS[name].params if isinstance(param, click.Option)]
    if any("OUT.rejected" in text for text in told):
        assert any(isinstance(param.type, JudgedOutput | Stage1AndFolder) for param in COMMANDS[name].params)


LINES = {
    "svo a.npz b.svo.pb": DeclaredPaths(("a.npz",), (), ("b.svo.pb",)),
    "svo a.npz b.svo.pb --min-psnr 30 --cameras c.json": DeclaredPaths(
        ("a.npz", "c.json"), (), ("b.svo.pb",), ("b.svo.pb.rejected",)
    ),
    "atlas in out --min-psnr 30": DeclaredPaths(("in",), (), ("out",), ("out.rejected",)),
    "atlas out --feature f0.jpg --feature f1.jpg --mlp m.json": DeclaredPaths(
        ("f0.jpg", "f1.jpg", "m.json"), (), ("out",)
    ),
    "compare a b --sheet s.png --html p.html --min-psnr 3": DeclaredPaths(("a", "b"), (), ("s.png", "p.html")),
    "fit photos a.npz --masks m --state s --plot c.svg": DeclaredPaths(("m",), ("photos",), ("a.npz", "c.svg"), ("s",)),
    "mesh a b.glb --views photos": DeclaredPaths(("a",), ("photos",), ("b.glb",)),
    "mesh a b.obj --min-psnr 9": DeclaredPaths(("a",), (), ("b.obj",), ("b.obj.rejected", "b.mtl", "b.png", "b.jpg")),
    "frames a.mp4 out": DeclaredPaths(("a.mp4",), (), ("out",)),
    "poses photos": DeclaredPaths(("photos",), (), ("photos/transforms.json", "photos/sparse/0")),
    "refit a b --views photos": DeclaredPaths(("a",), ("photos",), ("b",)),
    "render a --out p.png --depth --alpha --mesh m.glb": DeclaredPaths(
        ("a", "m.glb"), (), ("p.png", "p.depth.png", "p.alpha.png")
    ),
    "render a --out views --all --cameras c --depth npy": DeclaredPaths(("a", "c"), (), ("views",)),
    "sample capture out": DeclaredPaths((), (), ("out",)),
    "info a": DeclaredPaths(("a",)),
    "bench fit d --state s -o r.md": DeclaredPaths((), ("d",), ("r.md",), ("s",)),
    "bench formats a b -o r.md": DeclaredPaths(("a", "b"), (), ("r.md",)),
}


@pytest.mark.parametrize("line", LINES)
def test_what_a_line_reads_and_writes(line: str) -> None:
    words, group = line.split(), main.cli.commands
    command = group[words.pop(0)]
    command = command.commands[words.pop(0)] if isinstance(command, click.Group) else command
    found, wanted = declared(command, words), LINES[line]
    assert [sorted(paths) for paths in found] == [sorted(paths) for paths in wanted]
