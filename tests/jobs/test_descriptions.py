"""What a file is, in facts."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake.jobs import describe_file


@pytest.mark.usefixtures("folder")
def test_a_file_in_facts() -> None:
    facts = describe_file("a.svo.pb")
    assert (facts["file"], facts["format"], facts["nodes_per_level"]) == ("a.svo.pb", "svo.pb", [1, 8, 8])
    assert facts["bytes_on_disk"] == Path("a.svo.pb").stat().st_size
