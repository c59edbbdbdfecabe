"""All octree formats and profiles, for properties that hold in every one of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import build_octree, catalog
from nerfbake.memory import memory_limit
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import n3tree

FORMATS = {form.name: form for form in catalog.formats_of("SparseVoxelOctree")}
# (format, profile): svo.npz has only one.
SPELLINGS = [(name, profile) for name, form in FORMATS.items() for profile in form.choices("profile") or (None,)]
every_spelling = pytest.mark.parametrize(("name", "profile"), SPELLINGS)


def written(name: str, profile: str | None, octree: SparseVoxelOctree, *, no_child: int = 0) -> bytes:
    """Encode an octree. no_child is ignored by formats with a fixed value for "no child"."""
    options: dict[str, Any] = {"profile": profile} if profile else {}
    if FORMATS[name].choices("no_child"):
        options["no_child"] = no_child
    return b"".join(FORMATS[name].load_module().encode(octree, **options))


def read(name: str, data: bytes, *, limit: int = 1 << 24) -> SparseVoxelOctree:
    with memory_limit(limit):
        octree: SparseVoxelOctree = FORMATS[name].load_module().decode(memoryview(data))
    return octree


def small_octree(dtype: Any = np.float32) -> SparseVoxelOctree:
    """17 nodes on three levels, with a voxel size per axis. Values are multiples of 1/8, which tools print exactly."""
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=dtype, invradius=np.array([0.5, 0.25, 0.125]))
    octree = build_octree(tree, dtype=np.dtype(dtype).name)
    return replace(octree, node_data=np.round(octree.node_data * 8) / 8)


def points_around(octree: SparseVoxelOctree, count: int) -> npt.NDArray[np.float32]:
    """Points in voxel coordinates.

    `count` random points in and around the octree, three quarters as many on faces and at the next float beside them,
    and points far outside, with negative coordinates, infinities and NaN.
    """
    random, size = np.random.default_rng(0), np.array(octree.size)
    anywhere = random.uniform(-1.5, size + 1.5, (count, 3)).astype(np.float32)
    faces = random.integers(-1, size + 2, (count // 4, 3)).astype(np.float32)
    beside = np.nextafter(faces, random.choice(np.array([-np.inf, np.inf], np.float32), faces.shape))
    odd = np.array(np.meshgrid(*[[-0.0, 1e-45, -1e-45, 3e9, -3e9, np.inf, -np.inf, np.nan, 1.5]] * 3), np.float32)
    # Points with only one coordinate on a face.
    mixed = np.where(random.integers(0, 3, (len(faces), 1)) == np.arange(3), faces, anywhere[: len(faces)])
    return np.concatenate([anywhere, faces, beside, mixed, odd.reshape(3, -1).T])
