"""Each file compiles alone, and the files of a language compile in any choice that `nerfbake shaders` makes."""

from __future__ import annotations

import re

import pytest

from nerfbake.jobs.shaders import NEEDS, shader_text
from tests.support.shaders import HOME, Runner

NAMES = [name for name in NEEDS if name != "nanovdb"]  # nanovdb.h is compiled in test_nanovdb.py


def choice(runner: Runner, *names: str) -> list[str]:
    """Files to paste: WGSL has no #include, so there each file stands below what it needs, once."""
    if runner.language == "wgsl":
        return list(dict.fromkeys(part for name in names for part in (*NEEDS[name], name)))
    return list(names)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_compiles_alone(runner: Runner, name: str) -> None:
    runner.compile(choice(runner, name))


def test_all_files_compile_together_in_either_order(runner: Runner) -> None:
    runner.compile(choice(runner, *NAMES))
    runner.compile(choice(runner, *reversed(NAMES)))


@pytest.mark.parametrize("language", ["glsl", "hlsl"])
@pytest.mark.parametrize("name", NAMES)
def test_a_file_includes_what_the_table_says_and_has_a_guard(language: str, name: str) -> None:
    file = HOME / language / f"{name}.{language}"
    text = file.read_text() if file.is_file() else shader_text(f"{language}/{name}.{language}")
    assert tuple(re.findall(rf'(?m)^#include "(\w+)\.{language}"$', text)) == NEEDS[name]
    guard = f"NERFBAKE_{name.upper()}_{language.upper()}"
    code = re.sub(r"(?m)^//.*\n", "", text)
    assert code.startswith(f"#ifndef {guard}\n#define {guard}\n")
    assert code.endswith(f"#endif  // {guard}\n")
