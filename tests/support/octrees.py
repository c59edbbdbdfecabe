"""The octree formats and their profiles, for laws that hold in all of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nerfbake import build_octree, catalog
from nerfbake.memory import memory_limit
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import n3tree

FORMATS = {form.name: form for form in catalog.formats_of("SparseVoxelOctree")}
# (format's name, profile): svo.npz is written in one way only.
SPELLINGS = [(name, profile) for name, form in FORMATS.items() for profile in form.choices("profile") or (None,)]
every_spelling = pytest.mark.parametrize(("name", "profile"), SPELLINGS)


def written(name: str, profile: str | None, octree: SparseVoxelOctree, *, no_child: int = 0) -> bytes:
    """The file; a format that spells "no child" in one way alone does so."""
    options: dict[str, Any] = {"profile": profile} if profile else {}
    if FORMATS[name].choices("no_child"):
        options["no_child"] = no_child
    return b"".join(FORMATS[name].load_module().encode(octree, **options))


def read(name: str, data: bytes, *, limit: int = 1 << 24) -> SparseVoxelOctree:
    with memory_limit(limit):
        octree: SparseVoxelOctree = FORMATS[name].load_module().decode(memoryview(data))
    return octree


def small_octree(dtype: Any = np.float32) -> SparseVoxelOctree:
    """17 nodes at three levels, voxels of three sizes; values are eighths, which every tool prints in full."""
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=dtype, invradius=np.array([0.5, 0.25, 0.125]))
    octree = build_octree(tree, dtype=np.dtype(dtype).name)
    return replace(octree, node_data=np.round(octree.node_data * 8) / 8)
