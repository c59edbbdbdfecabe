"""The files of a language stand behind one another in any choice that `nerfbake shaders` makes."""

from __future__ import annotations

import pytest

from nerfbake.jobs.shaders import NEEDS
from tests.support.shaders import Runner

CHOICES = {name: (*needs, name) for name, needs in NEEDS.items() if name != "nanovdb"}
CHOICES["all"] = tuple(dict.fromkeys(part for choice in CHOICES.values() for part in choice))


@pytest.mark.parametrize("choice", CHOICES)
def test_what_a_file_needs_is_all_that_it_needs(runner: Runner, choice: str) -> None:
    runner.compile(CHOICES[choice])
