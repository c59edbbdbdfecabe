"""`--help`: every command in a group, its summary whole at 80 columns."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from nerfbake.cli.main import GROUPS, cli


def commands(group: click.Group, above: str = "") -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        yield f"{above}{name}", command
        if isinstance(command, click.Group):
            yield from commands(command, f"{above}{name} ")


ALL = dict(commands(cli))


@pytest.mark.parametrize("name", ALL)
def test_a_summary_has_50_characters_at_most(name: str) -> None:
    text = (ALL[name].help or "").splitlines()[0]
    assert text.endswith(".")
    assert 10 < len(text.removesuffix(".")) <= 50


@pytest.mark.parametrize("name", ["", *(name for name, command in ALL.items() if isinstance(command, click.Group))])
def test_no_summary_is_cut_at_80_columns(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = CliRunner().invoke(cli, [*name.split(), "--help"], prog_name="nerfbake").output
    assert "..." not in shown.partition("\n")[2]  # the first line says "[ARGS]..."
    assert max(map(len, shown.splitlines())) <= 80
    group = ALL[name] if name else cli
    assert isinstance(group, click.Group)
    for command in group.commands.values():
        assert (command.help or "").splitlines()[0] in shown


def test_each_command_is_in_one_group() -> None:
    grouped = [command.name for members in GROUPS.values() for command in members]
    assert sorted(map(str, grouped)) == sorted(cli.commands)
