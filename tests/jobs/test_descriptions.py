"""What a file is, in facts."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import SplatLevels
from nerfbake.io import save_folder
from nerfbake.jobs import describe_file
from tests.support.splats import splats


@pytest.mark.usefixtures("folder")
def test_a_file_in_facts() -> None:
    facts = describe_file("a.svo.pb")
    assert (facts["file"], facts["format"], facts["nodes_per_level"]) == ("a.svo.pb", "svo.pb", [1, 8, 8])
    assert facts["bytes_on_disk"] == Path("a.svo.pb").stat().st_size


@pytest.mark.usefixtures("folder")
def test_the_files_of_all_levels_are_counted() -> None:
    save_folder("levels", SplatLevels((splats(40), splats(10))))
    sizes = {path: path.stat().st_size for path in Path("levels").rglob("*") if path.is_file()}
    assert describe_file("levels")["bytes_on_disk"] == sum(sizes.values())
    finest = sum(size for path, size in sizes.items() if path.parent.name in ("levels", "0_0"))
    assert describe_file("levels/lod-meta.json")["bytes_on_disk"] == finest
