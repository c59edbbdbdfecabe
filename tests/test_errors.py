"""One line for a person: printable, short, and it always says what is allowed."""

from __future__ import annotations

import ast
import re
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

PACKAGE = Path(nerfbake.__file__).parent


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
    ("error", "for_python", "for_shell"),
    [
        (
            OutputError("exists already; allowed: a new file, or --force", source="my--file.npz"),
            "my--file.npz: exists already; allowed: a new file, or `force`",
            "my--file.npz: exists already; allowed: a new file, or --force",
        ),
        (
            UsageError("has 2 grids; allowed: --grid NAME, no --no-child"),
            "has 2 grids; allowed: `grid=NAME`, no `no_child`",
            "has 2 grids; allowed: --grid NAME, no --no-child",
        ),
        (
            UsageError("--half is for volumes; allowed: `nerfbake svo --dtype float16`"),
            "`half` is for volumes; allowed: `nerfbake svo --dtype float16`",
            "--half is for volumes; allowed: `nerfbake svo --dtype float16`",
        ),
        (
            MemoryLimit("the tree", 2 << 20, 1 << 20),
            "the tree needs 2.0 MiB; allowed: 1.0 MiB (`memory_limit`)",
            "the tree needs 2.0 MiB; allowed: 1.0 MiB (--max-memory)",
        ),
        (InvalidFile("ends in -- or --3; allowed: a---b"), *["ends in -- or --3; allowed: a---b"] * 2),
    ],
)
def test_python_reads_of_arguments_and_a_shell_of_options(
    error: NerfbakeError, for_python: str, for_shell: str
) -> None:
    assert str(error) == for_python
    assert error.line == for_shell


def test_every_option_in_a_text_of_the_library_is_an_argument_there() -> None:
    """Texts below `nerfbake.cli` name options, and str() turns them into arguments."""
    arguments, options = {"memory_limit"}, set()
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] in ("cli", "bench", "batch"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.arg):
                arguments.add(node.arg)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                arguments.add(node.target.id)
            elif isinstance(node, ast.Raise):
                for text in (part for part in ast.walk(node) if isinstance(part, ast.Constant)):
                    options |= set(re.findall(r"`([a-z_]+)`", str(UsageError(str(text.value)))))
    assert len(options) > 20
    assert options - {"float32", "float16"} <= arguments
