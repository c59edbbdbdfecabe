"""Levels of splats in a folder with lod-meta.json: the tree, the rows of each part, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfbake import SplatLevels, Splats, load
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.splat import sog, sog_levels, sog_writer
from nerfbake.io import save_folder
from tests.formats.splat.test_ply import assert_same
from tests.support.splats import sog_levels as levels_of_parts
from tests.support.splats import splats


def written(scene: SplatLevels) -> dict[str, bytes]:
    return {name: b"".join(pieces) for name, pieces in sog_levels.encode(scene)}


def views(files: dict[str, bytes]) -> dict[str, memoryview]:
    return {name: memoryview(data) for name, data in files.items()}


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [each for child in node["children"] for each in leaves(child)] if "children" in node else [node]


@given(st.lists(st.integers(1, 300), min_size=1, max_size=3), st.sampled_from([8, 64, 1000]))
@settings(max_examples=5, deadline=None)
def test_each_splat_is_in_one_part_of_its_level(sizes: list[int], most: int) -> None:
    scene = SplatLevels(tuple(splats(n, degree=k % 2, seed=k) for k, n in enumerate(sizes)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sog_levels, "_LEAF", most)
        patch.setattr(sog_levels, "_FILE", 2 * most)
        files = written(scene)
    meta = json.loads(files["lod-meta.json"])
    assert (meta["version"], meta["counts"], meta["count"]) == (1, sizes, sum(sizes))
    found = sog_levels.decode(views(files))
    for level, (before, after) in enumerate(zip(scene.levels, found.levels, strict=True)):
        np.testing.assert_allclose(np.sort(after.means, axis=0), np.sort(before.means, axis=0), atol=5e-4)
        own = [each["lods"][str(level)] for each in leaves(meta["tree"]) if str(level) in each["lods"]]
        assert sum(each["count"] for each in own) == before.n
        used: dict[int, int] = {}
        for each in own:  # the ranges of a file follow each other
            assert each["offset"] == used.get(each["file"], 0)
            used[each["file"]] = each["offset"] + each["count"]
            assert meta["filenames"][each["file"]].startswith(f"{level}_")
    for leaf in leaves(meta["tree"]):
        assert sum(each["count"] for each in leaf["lods"].values()) <= most
        for level, each in leaf["lods"].items():
            folder = meta["filenames"][each["file"]].removesuffix("meta.json")
            part = sog.splats_in({
                name.removeprefix(folder): data for name, data in views(files).items() if name.startswith(folder)
            }).take(slice(each["offset"], each["offset"] + each["count"]))  # fmt: skip
            low, high = (np.array(leaf["bound"][key]) for key in ("min", "max"))
            inside = (part.means - part.reach() >= low - 2e-3) & (part.means + part.reach() <= high + 2e-3)
            assert inside.all(), level


def test_a_folder_is_read_as_its_levels_and_as_its_finest(tmp_path: Path) -> None:
    scene = SplatLevels((splats(40, degree=1), splats(10, degree=1, seed=1)))
    save_folder(tmp_path / "a", scene)
    found = load(tmp_path / "a", SplatLevels)
    assert [level.n for level in found.levels] == [40, 10]
    assert_same(load(tmp_path / "a", Splats), found.levels[0], atol=0)
    assert_same(load(tmp_path / "a" / "lod-meta.json", Splats), found.levels[0], atol=0)
    np.testing.assert_allclose(found.levels[1].means, sog_writer.in_order(scene.levels[1]).means, atol=3e-4)


def test_levels_of_playcanvas_are_read_with_the_environment() -> None:
    found = sog_levels.decode(views(levels_of_parts(environment="env/meta.json")))
    assert [level.n for level in found.levels] == [4 + 3 + 3, 2 + 3 + 3]


def test_what_cannot_be_written_or_read_is_one_line() -> None:
    with pytest.raises(InvalidScene, match=r"sh has degree 4; allowed: 0 to 3 in a \.sog"):
        written(SplatLevels((splats(3, degree=4),)))
    with pytest.raises(InvalidScene, match="the levels of splats are none; allowed: one or more"):
        SplatLevels(())
    with pytest.raises(InvalidFile, match=r"lod-meta\.json is missing"):
        sog_levels.decode({})
    leaf = {"lods": {str(level): {"file": 0, "offset": 0, "count": 1} for level in range(33)}}
    with pytest.raises(InvalidFile, match=r"lod-meta\.json has 33 levels; allowed: at most 32"):
        sog_levels.decode(views(levels_of_parts(tree=leaf)))
