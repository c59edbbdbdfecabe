"""Templates and files of lines: what is put in where, whatever it is called."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfbake.batch.items import Item, fill_template, parse_lines
from nerfbake.errors import UsageError

# What a path may hold: anything but NUL and, as Python writes bytes that are no UTF-8, lone surrogates.
names = st.text(st.characters(codec="utf-8", exclude_characters="\0") | st.just("\udcff"), min_size=1)


def test_every_placeholder_is_filled() -> None:
    (line,) = fill_template("svo {in} 'a b'/{dir}/{stem}-{name} --title {{{stem}}}", ["scenes/chair.svo.pb.zst"])
    path, out = "scenes/chair.svo.pb.zst", "a b/scenes/chair-chair.svo.pb.zst"
    assert line.argv == ("svo", path, out, "--title", "{chair}")


@pytest.mark.parametrize(
    ("name", "stem"), [("a.npz", "a"), ("a.vdb.npz", "a"), ("A.NPZ", "A"), ("a.b.txt", "a.b"), ("scene", "scene")]
)
def test_a_stem_is_a_name_without_the_ending_of_a_format(name: str, stem: str) -> None:
    assert fill_template("svo {in} {stem}", [name])[0].argv[2] == stem


@pytest.mark.parametrize(
    ("template", "said"),
    [
        ("svo {in} {out}", "the template has '{out}'; allowed: {in}, {name}, {stem}, {dir}, and {{ or }} for a brace"),
        ("svo {in} {", "the template has '{'; allowed"),
        ("svo a.npz b.npz", "the template has no {in}; allowed"),
        ("svo '{in} b", "the template has no closing quotation; allowed: a command line, quoted as for a shell"),
    ],
)
def test_a_template_that_says_nothing_is_refused(template: str, said: str) -> None:
    with pytest.raises(UsageError) as caught:
        fill_template(template, ["a.npz"])
    assert said in str(caught.value)


@settings(max_examples=30)
@given(names)
def test_a_name_is_put_in_as_it_is(name: str) -> None:
    assert fill_template("svo {in} out", [name])[0].argv == ("svo", name, "out")


@settings(max_examples=30)
@given(st.lists(st.lists(names, min_size=1).map(tuple), min_size=1))
def test_lines_are_read_as_they_were_written(lines: list[tuple[str, ...]]) -> None:
    text = "# a comment\n\n" + "".join(f"{Item(words).line}\n" for words in lines)
    assert [line.argv for line in parse_lines(text, "jobs.txt")] == lines


def test_a_file_of_an_editor_on_windows_is_read() -> None:
    found = [line.argv for line in parse_lines("\ufeffsvo a.npz a.svo.pb\r\nsvo b.npz b.svo.pb\r\n", "jobs.txt")]
    assert found == [("svo", "a.npz", "a.svo.pb"), ("svo", "b.npz", "b.svo.pb")]


def test_a_line_goes_on_behind_a_backslash_and_may_lack_the_program() -> None:
    found = list(parse_lines("svo a.npz \\\n  a.svo.pb\n  # no line\nnerfbake info 'a b'\n", "jobs.txt"))
    assert [line.argv for line in found] == [("svo", "a.npz", "a.svo.pb"), ("info", "a b")]
    assert [line.place for line in found] == ["jobs.txt, line 1", "jobs.txt, line 4"]


@pytest.mark.parametrize("text", ["svo a\nsvo 'b\n", "svo a\nsvo b\\", "svo a\nsvo '" + "b\n" * 40000])
def test_a_line_without_an_end_is_told_where_it_begins(text: str) -> None:
    with pytest.raises(UsageError, match=r"^jobs.txt, line 2 has no "):
        list(parse_lines(text, "jobs.txt"))


def test_a_command_can_be_pasted_whatever_its_names_hold() -> None:
    assert Item(("svo", "a b", "it's")).line == "nerfbake svo 'a b' 'it'\"'\"'s'"
    assert Item(("svo", "a\n'\\\udcff")).line == r"nerfbake svo $'a\x0a\x27\x5c\xff'"


@pytest.mark.parametrize("text", ["svo a b\nsvo a\0 b\n", "svo a b\nsvo 'a\n\0'\n"])
def test_a_nul_is_told_with_the_number_of_its_line(text: str) -> None:
    with pytest.raises(UsageError, match=r"^jobs.txt, line 2 has a NUL; allowed: a command line"):
        list(parse_lines(text, "jobs.txt"))
