"""Subjects of commits: `scope: what changes`, at most 72 characters, in every commit since this rule."""

from __future__ import annotations

import re
import subprocess

import pytest

from tests.conftest import REPOSITORY

SINCE = "ed6809836f79d2d0d0cdd5b2d36ff7a8bfa6be3e"
LONGEST = 72  # characters
SUBJECT = re.compile(r"[\w./-]+(, [\w./-]+)*: \S.*")


def subjects() -> list[str]:
    """The subjects of all commits after SINCE but merges; none without git, and where SINCE is not in the history."""
    command = ["git", "-C", str(REPOSITORY), "log", "--no-merges", "--format=%s", f"{SINCE}..HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        print(f"no history since {SINCE}: subjects of commits are not checked")
        return []
    return done.stdout.splitlines()


def problem(subject: str) -> str:
    """What is wrong with a subject; '' if nothing is."""
    if len(subject) > LONGEST:
        return f"{subject!r} has {len(subject)} characters; allowed: {LONGEST}"
    return "" if SUBJECT.fullmatch(subject) else f"{subject!r} has no scope; allowed: `scope: what changes`"


def test_every_subject_is_a_scope_and_what_changes() -> None:
    assert [text for text in map(problem, subjects()) if text] == []


@pytest.mark.parametrize(
    ("subject", "wrong"),
    [
        ("fit: keep the checkpoint after an error", ""),
        ("compress, view: use fewer rays", ""),
        ("x: " + "a" * 69, ""),
        ("x: " + "a" * 70, "has 73 characters; allowed: 72"),
        ("Read again", "has no scope"),
        ("A new file is not replaced: two cases", "has no scope"),
        ("fit:keep", "has no scope"),
        ("fit: ", "has no scope"),
    ],
)
def test_a_subject(subject: str, wrong: str) -> None:
    assert wrong in problem(subject)
    assert bool(wrong) == bool(problem(subject))
