"""Frozen bytes of every format, profile and dtype: what was written once is read for ever, and written the same.

`python -m tests.test_golden` (make golden) writes them anew; nothing else does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import load, save
from nerfbake.scene.octree import SparseVoxelOctree
from tests.formats.octree.octrees import SPELLINGS, written
from tests.support.scenes import assert_same_octree

GOLDEN = Path(__file__).parent / "golden"


def scenes() -> Iterator[tuple[str, SparseVoxelOctree]]:
    """Three levels of a 4 x 3 x 2 grid, written out here so that no change elsewhere moves them."""
    children = np.zeros((6, 8), np.int32)
    children[0, [1, 6]] = [1, 2]
    children[2, [0, 3, 7]] = [3, 4, 5]
    data = (np.arange(24).reshape(6, 4) - 5) / 8
    data[:, 3] = [0.5, 1, 2, 0.1, 300, 0]
    full = SparseVoxelOctree((4, 3, 2), children, data.astype(np.float32), "RGBA", np.array([1, -2, 0.3]))
    yield "full_float32", full
    yield "compact_float16", replace(full, node_data=data.astype(np.float16)).with_layout("compact")
    lobes = (np.arange(4) / 3).astype(np.float32).reshape(1, 4)
    yield "lobes_float32", replace(full, data_format="SG1", extra_data=lobes, voxel_size=np.array([0.5, 0.25, 1 / 3]))


FILES = [(name, profile, scene) for name, profile in SPELLINGS for scene, _ in scenes()]


def path_of(name: str, profile: str | None, scene: str) -> Path:
    return GOLDEN / f"{scene}{f'_{profile}' if profile else ''}.{name}"


@pytest.mark.parametrize(("name", "profile", "scene"), FILES)
def test_frozen_bytes_are_read_and_written_again(name: str, profile: str | None, scene: str) -> None:
    path, octree = path_of(name, profile, scene), dict(scenes())[scene]
    assert_same_octree(load(path, SparseVoxelOctree), octree)
    assert written(name, profile, octree) == path.read_bytes()


def test_a_frozen_compressed_file_is_read() -> None:
    # Other versions of zstd may pack the same content differently: only reading is promised.
    assert_same_octree(load(GOLDEN / "full_float32.svo.pb.zst", SparseVoxelOctree), dict(scenes())["full_float32"])


def test_nothing_else_lies_there() -> None:
    expected = {path_of(*file).name for file in FILES} | {"full_float32.svo.pb.zst"}
    assert {path.name for path in GOLDEN.iterdir()} == expected


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for name, profile, scene in FILES:
        path_of(name, profile, scene).write_bytes(written(name, profile, dict(scenes())[scene]))
    save(GOLDEN / "full_float32.svo.pb.zst", dict(scenes())["full_float32"], force=True)
