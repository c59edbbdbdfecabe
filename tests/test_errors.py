"""One line for a person: printable, short, and it always says what is allowed."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import nerfbake
from nerfbake.errors import (
    LONGEST_LINE,
    InvalidFile,
    MemoryLimit,
    NerfbakeError,
    OutputError,
    Problem,
    UsageError,
    one_line,
)
from tests.support.source import parsed

PACKAGE = Path(nerfbake.__file__).parent
# A command line of its own, CSS, and the options of pip and uv.
FLAGS = {"batch/items.py", "formats/page/shipment.py", "formats/wire/page.py", "installation.py"}


def test_a_short_line_stays_as_it_is() -> None:
    assert one_line("child[0] points to node 9; allowed: 0 to 7") == "child[0] points to node 9; allowed: 0 to 7"


def test_line_breaks_and_escape_codes_go() -> None:
    assert one_line("a\nb\x1b[2Jc\x00d") == "a b [2Jc d"


@pytest.mark.parametrize("length", [100, 300, 3_000, 300_000])
def test_a_long_value_never_pushes_out_what_is_allowed(length: int) -> None:
    """Each NUL of a repr takes four characters."""
    allowed = "a name of letters, digits, dots, dashes and underscores, at most 200 of them, that no other line has"
    line = Problem("line 3", f"has the name {chr(0) * length!r}", allowed).line
    assert len(line) <= LONGEST_LINE
    assert line.startswith("line 3 has the name '")
    assert line.endswith(f"'; allowed: {allowed}")


def test_both_parts_are_shortened_where_both_are_long() -> None:
    line = str(InvalidFile(Problem("grid", "is " + "x" * 5_000, "y" * 5_000)))
    assert len(line) == LONGEST_LINE
    assert "x; allowed: y" in line


def test_a_text_without_what_is_allowed_keeps_its_start_and_its_end() -> None:
    line = one_line("start " + "x" * 5_000 + " end")
    assert len(line) == LONGEST_LINE
    assert line.startswith("start x")
    assert line.endswith("x end")


@pytest.mark.parametrize(
    ("error", "said", "in_a_shell"),
    [
        (
            OutputError("exists already; allowed: a new file, or `force`", source="a.npz"),
            "a.npz: exists already; allowed: a new file, or `force`",
            "a.npz: exists already; allowed: a new file, or --force",
        ),
        (
            UsageError("has 2 grids; allowed: `grid=NAME`, no `no_child`"),
            "has 2 grids; allowed: `grid=NAME`, no `no_child`",
            "has 2 grids; allowed: --grid NAME, no --no-child",
        ),
        (
            UsageError("`half` is for volumes; allowed: `nerfbake svo --dtype float16`"),
            "`half` is for volumes; allowed: `nerfbake svo --dtype float16`",
            "--half is for volumes; allowed: `nerfbake svo --dtype float16`",
        ),
        (
            MemoryLimit("the tree", 2 << 20, 1 << 20),
            "the tree needs 2.0 MiB; allowed: 1.0 MiB (`memory_limit`)",
            "the tree needs 2.0 MiB; allowed: 1.0 MiB (--max-memory)",
        ),
        (InvalidFile("ends in ` or ``; allowed: a`b"), *["ends in ` or ``; allowed: a`b"] * 2),
    ],
)
def test_python_reads_of_arguments_and_a_shell_of_options(error: NerfbakeError, said: str, in_a_shell: str) -> None:
    assert str(error) == said
    assert error.line == in_a_shell


def _texts(tree: ast.AST) -> Iterator[str]:
    """The strings of a module that are no docstrings."""
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def test_texts_below_the_command_line_name_arguments() -> None:
    """`force`, `grid=NAME`: the command line turns them into options. Whole command lines may stand in backticks."""
    arguments, named, wrong = {"memory_limit"}, set(), []
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE)
        if name.parts[0] in ("cli", "bench"):
            continue
        tree = parsed(path)
        for node in ast.walk(tree):
            if isinstance(node, ast.arg):
                arguments.add(node.arg)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                arguments.add(node.target.id)
        for text in _texts(tree):
            outside = "".join(text.split("`")[::2])
            if re.search(r"(?<![\w-])--[a-z]", outside) and name.as_posix() not in FLAGS:
                wrong.append(f"{name}: {text}")
            named |= set(re.findall(r"`([a-z][a-z0-9_]*)(?:=[^`]*)?`", text))
    assert wrong == []
    assert len(named) > 30
    assert named <= arguments
