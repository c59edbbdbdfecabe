from __future__ import annotations

import sys
from typing import Any

import pytest

from benchmarks.processes import in_turn, measure_process
from nerfbake.errors import NerfbakeError


def python(code: str, **environment: str) -> Any:
    return measure_process(sys.executable, "-S", "-c", code, environment=environment)


def test_seconds_and_peak_are_those_of_the_command_alone() -> None:
    parent: Any = bytearray(b"x") * (200 << 20)  # a child must not have this as its own peak
    idle = python("import time; time.sleep(0.3)")
    filled = python("b'x' * (80 << 20)")
    assert 0.3 <= idle.seconds < 10
    assert idle.peak < 80 << 20
    assert 78 << 20 < filled.peak < 160 << 20
    assert len(parent) == 200 << 20
    assert idle.facts["worked"] < 0.3
    assert python("while __import__('time').process_time() < 0.3: pass").facts["worked"] >= 0.3


def test_the_command_sees_the_variables_that_it_is_given_and_keeps_its_compiled_modules() -> None:
    python(
        "import os, sys; sys.exit(os.environ['COLOUR'] != 'red' or sys.dont_write_bytecode or not sys.pycache_prefix)",
        COLOUR="red",
    )


def test_a_command_that_fails_is_told_with_its_last_words() -> None:
    with pytest.raises(NerfbakeError, match=r"-c import no_such exited with 1: ModuleNotFoundError: No module named"):
        python("import no_such")


def test_works_take_turns_and_the_first_round_does_not_count() -> None:
    calls: list[str] = []

    def work(name: str) -> int:
        calls.append(name)
        return len(calls)

    found = in_turn(lambda: work("a"), lambda: work("b"), rounds=2)
    assert calls == ["a", "b"] * 3
    assert found == [[3, 5], [4, 6]]
