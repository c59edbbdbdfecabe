"""One line for a person: printable, short, and it always says what is allowed."""

from __future__ import annotations

import pytest

from nerfbake.errors import LONGEST_LINE, InvalidFile, Problem, one_line


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
