"""Names of files, and names in files, are printable on stdout, too: no escapes for the terminal, no forged lines."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nerfbake import io
from nerfbake.batch.items import parse_lines
from nerfbake.bench.report import Report, Table, document
from nerfbake.cli import compare, info
from nerfbake.cli.main import run

# An escape for colours, a forged line, C1's CSI, DEL, a bidirectional override, and a line separator.
HOSTILE = "a\x1b[31m\nforged.npz: ok\r\x9b2J\x7f\u202egnp\u2028x"
CLEAN = "a [31m forged.npz: ok 2J gnp x"


def lines(text: str) -> list[str]:
    """The printed lines, all of which are printable."""
    found = text.split("\n")
    assert all(line.isprintable() for line in found), found
    assert not any(line.startswith("forged") for line in found), found
    return found


@pytest.fixture
def hostile_file(tree_file: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tree_file.parent)
    tree_file.rename(f"{HOSTILE}.npz")
    return f"{HOSTILE}.npz"


def test_info_and_check(hostile_file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", hostile_file]) == 0
    assert f"file                {CLEAN}.npz" in lines(capsys.readouterr().out)
    assert run(["check", hostile_file]) == 0
    assert lines(capsys.readouterr().err) == [f"{CLEAN}.npz: ok", ""]
    Path(hostile_file).write_bytes(b"x")
    assert run(["check", hostile_file]) == 1
    (line, end) = lines(capsys.readouterr().out)
    assert (line[: len(CLEAN) + 6], end) == (f"{CLEAN}.npz: ", "")
    assert run(["info", hostile_file]) == 1
    assert len(lines(capsys.readouterr().err)) == 2


def test_json_has_the_name_as_it_is(hostile_file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", hostile_file, "--json"]) == 0
    (line, _) = lines(capsys.readouterr().out)
    assert line.isascii()
    assert json.loads(line)["file"] == hostile_file


def test_names_of_cameras_in_a_comparison(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"psnr": 30.0, "ssim": 1.0, "max_error": 0.0}
    found = SimpleNamespace(means={"a_b": errors}, views=[{"name": HOSTILE, "a_b": errors}], values={}, samples=1)
    compare._print(SimpleNamespace(found=found, a={"bytes": 1}, b={"bytes": 2}))  # type: ignore[arg-type]
    assert any(line.startswith(f"{CLEAN}IN - IN2") for line in lines(capsys.readouterr().out))


def test_a_plan_has_the_names_with_escapes_that_a_jobs_file_may_have(
    hostile_file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["batch", "info {in}", hostile_file, "--plan"]) == 0
    plan = capsys.readouterr().out
    assert len(lines(plan)) == 3
    (found,) = parse_lines(plan, "the plan")
    assert found.argv == ("info", hostile_file)


@pytest.mark.parametrize(
    "facts",
    [
        {"file": HOSTILE},
        {"grids": {HOSTILE: {"type": HOSTILE}}},
        {"names": [HOSTILE, HOSTILE]},
        {"sizes": {HOSTILE: {HOSTILE: 1}}},
        {"cascades": {HOSTILE: {"x": {"y": [HOSTILE]}}}},
    ],
)
def test_names_inside_a_file(facts: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    info._table(facts)
    assert CLEAN in "\n".join(lines(capsys.readouterr().out))


@pytest.mark.parametrize("kind", ["md", "json"])
def test_a_report_of_a_benchmark(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    report = Report("a report", {"scene": HOSTILE}, [Table("t", ["scene"], [[HOSTILE]])], ["a note"])
    io.print_text(document([report], kind))
    lines(capsys.readouterr().out)


def test_whatever_else_is_printed_has_no_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    io.print_text(HOSTILE)
    assert capsys.readouterr().out.split("\n")[0] == "a [31m"
