"""The list of files: docs/ship.md says the same, and every program stands in a page that says how it was tested."""

from __future__ import annotations

import re

import pytest

from nerfbake.errors import UsageError
from nerfbake.jobs.shipping_list import FILES, TARGETS, require_targets
from tests.conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "ship.md").read_text()


def test_files_come_once_in_the_order_of_the_list_with_all_their_targets() -> None:
    assert require_targets(("omniverse", "ios", "ios")) == {
        "scene.html": ("ios",),
        "mesh.usdz": ("ios", "omniverse"),
        "splats.usdc": ("omniverse",),
    }
    assert [*require_targets(tuple(TARGETS))] == [*FILES]


def test_a_name_that_is_no_target_brings_a_suggestion() -> None:
    for name, near in (("blendr", "blender"), ("IOS", "ios"), ("Web", "web"), ("unit", "unity")):
        with pytest.raises(UsageError, match=rf"'{name}' is no target, perhaps '{near}' is meant; allowed: blender"):
            require_targets((name,))
    with pytest.raises(UsageError, match=r"'houdini' is no target; allowed: "):
        require_targets(("houdini",))


def test_the_page_says_for_whom_each_file_is() -> None:
    told = {
        row[1]: tuple(re.findall(r"`([^`]+)`", row[2])) for row in re.finditer(r"^\| `(\w+)` \| (`.*) \|$", PAGE, re.M)
    }
    assert {target: set(files) for target, files in told.items()} == {key: set(files) for key, files in TARGETS.items()}


def test_the_page_says_which_programs_read_each_file() -> None:
    told = re.findall(r"^\| `([\w.]+)` \| ([^|]+) \| ([^|]*) \| (ran|read|not run) \|$", PAGE, re.M)
    known = [
        (name, f"{each.program} {each.version}".strip(), each.reads, each.known)
        for name, listed in FILES.items()
        for each in listed.readers
    ]
    assert [(name, program, reads.strip(), how) for name, program, reads, how in told] == known


def test_a_program_of_which_nothing_is_known_is_not_said_to_read() -> None:
    for name, listed in FILES.items():
        for each in listed.readers:
            assert (each.known == "not run") == (each.reads == ""), name
