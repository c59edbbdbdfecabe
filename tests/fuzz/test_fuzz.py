"""Run the fuzzer for about a minute, and check that it detects each kind of finding."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import io
from nerfbake.errors import InvalidFile
from tests.fuzz import campaign as watching
from tests.fuzz import corpus
from tests.fuzz.breakage import Case, case_of
from tests.fuzz.campaign import Result, campaign, numbers
from tests.fuzz.trial import LIMIT, SLACK, Trial

CASES = 700
SOUND = Case(0, "obj", "case.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")


def whole(seed: int, cases: int, jobs: int = 1) -> Result:
    *_, result = campaign(seed, jobs=jobs, cases=cases)
    return result


@pytest.mark.long
def test_hundreds_of_broken_files() -> None:
    """`python -m tests.fuzz --minutes 30` tries more cases, and prints the command that repeats a finding."""
    result = whole(0, CASES)  # a second process would first try every sound file, too: 5 CPU seconds
    assert [first for first, *_ in result.by_key().values()] == []
    assert set(result.tried) == set(corpus.names())
    assert sum(result.tried.values()) == CASES


def test_a_case_is_the_same_again() -> None:
    for number in range(2 * len(corpus.names())):
        assert case_of(3, number) == case_of(3, number)
    assert case_of(3, 0) != case_of(4, 0)
    assert [case_of(0, number).form for number, _ in zip(numbers("glb"), range(3), strict=False)] == ["glb"] * 3


def test_a_sound_file_is_no_finding(tmp_path: Path) -> None:
    assert Trial(SOUND, tmp_path).run() == []


def _fails(*_: Any, **__: Any) -> None:
    raise IndexError("out of range")


def _warns(*_: Any, **__: Any) -> None:
    warnings.warn("overflow", RuntimeWarning, stacklevel=1)


class Talkative(InvalidFile):
    def __str__(self) -> str:
        return "x" * 301


def _talks(*_: Any, **__: Any) -> None:
    raise Talkative("")


def _takes_memory(*_: Any, **__: Any) -> None:
    np.ones(LIMIT + SLACK + (1 << 20), np.uint8)


HARMS: dict[str, tuple[Callable[..., None], str]] = {
    "exception": (_fails, "IndexError: out of range"),
    "warning": (_warns, "RuntimeWarning: overflow"),
    "long message": (_talks, "message of 301 characters"),
    "memory": (_takes_memory, "MiB to load, allowed 64"),
}


@pytest.mark.parametrize("harm", HARMS)
def test_a_harm_is_a_finding(harm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work, said = HARMS[harm]
    monkeypatch.setattr(io, "load", work)
    (found,) = Trial(SOUND, tmp_path).run()
    assert said in found.what


def test_a_process_that_dies_is_a_finding_and_the_rest_is_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dying.py").write_text(
        "import json, os, sys\n"
        "for line in sys.stdin:\n"
        "    with open(sys.argv[2], 'r+b') as file:\n"
        "        file.write(int(line).to_bytes(8, 'little'))\n"
        "    if int(line) in (5, 6):\n"
        "        os.abort()\n"
        "    print(json.dumps({'case': int(line), 'findings': []}), flush=True)\n"
    )
    monkeypatch.setattr(watching, "COMMAND", [sys.executable, str(tmp_path / "dying.py")])
    result = whole(0, 20, jobs=2)
    assert [(found.case, found.what) for found in sorted(result.findings, key=lambda found: found.case)] == [
        (5, "the process dies (exit code -6)"),
        (6, "the process dies (exit code -6)"),
    ]
    assert sum(result.tried.values()) == 18
