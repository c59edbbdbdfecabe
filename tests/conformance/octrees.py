"""Octrees in all formats, profiles, layouts and dtypes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from nerfbake import load
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conformance.case import Case, Facts, Frozen, floats, form_named
from tests.support.octrees import FORMATS, SPELLINGS

Row = list[float]
Voxel = tuple[int, ...]

# Places to look up, in voxels: in leaves of every size, in empty space, near the grid's end, outside. None is nearer
# than 1/16 to a voxel's face or centre plane, where rounding would choose.
PLACES = [
    (0.25, 0.75, 0.25),
    (1.875, 1.125, 0.8125),
    (2.25, 0.375, 1.375),
    (3.125, 1.625, 0.25),
    (3.75, 3.25, 1.75),
    (2.625, 2.375, 0.625),
    (3.25, 3.625, 1.625),
    (0.875, 2.875, 3.125),
    (3.375, 0.625, 6.75),
    (2.75, 0.25, 7.375),
    (4.375, 3.75, 2.125),
    (-0.25, 0.375, 0.625),
    (4.25, 1.25, 0.75),
    (1.375, -2.25, 0.875),
    (900.25, 1.25, 1.25),
]


def scenes() -> dict[str, SparseVoxelOctree]:
    """Written out here so that no change elsewhere moves them.

    The first three have three levels of a 4 x 3 x 2 grid, sh4 four of 5 x 4 x 8 with leaves on all but the first.
    """
    children = np.zeros((6, 8), np.int32)
    children[0, [1, 6]] = [1, 2]
    children[2, [0, 3, 7]] = [3, 4, 5]
    data = (np.arange(24).reshape(6, 4) - 5) / 8
    data[:, 3] = [0.5, 1, 2, 0.1, 300, 0]
    full = SparseVoxelOctree((4, 3, 2), children, data.astype(np.float32), "RGBA", np.array([1, -2, 0.3]))
    lobes = (np.arange(4) / 3).astype(np.float32).reshape(1, 4)
    return {
        "full_float32": full,
        "compact_float16": replace(full, node_data=data.astype(np.float16)).with_layout("compact"),
        "lobes_float32": replace(full, data_format="SG1", extra_data=lobes, voxel_size=np.array([0.5, 0.25, 1 / 3])),
        "sh4_float32": _deep(),
    }


def _deep() -> SparseVoxelOctree:
    children = np.zeros((8, 8), np.int32)  # the four nodes of the last level have no slots
    children[0, [0, 1, 4]] = [1, 2, 3]
    children[1, [0, 3, 6]] = [4, 5, 6]
    children[3, 5] = 7
    children[5, [0, 7]] = [8, 9]
    children[7, [1, 4]] = [10, 11]
    data = (np.arange(156).reshape(12, 13) % 31 - 15) / 16
    data[:, 12] = [0, 4, 8, 0.25, 1, 0.5, 16, 2, 3, 0.125, 40, 6]
    return SparseVoxelOctree(
        (5, 4, 8),
        children,
        data.astype(np.float32),
        "SH4",
        np.array([-1.0, 0.5, 0.25]),
        np.array([0.25, 0.125, 0.5]),
    )


LEVEL_SIZES = {"sh4_float32": [1, 3, 4, 4]}


def cases() -> Iterator[Case]:
    for name, octree in scenes().items():
        files: dict[str, tuple[str, str | None, Facts]]
        files = {path_of(spelling, profile, name): (spelling, profile, {}) for spelling, profile in SPELLINGS}
        if name == "full_float32":
            for spelling, profile in (each for each in SPELLINGS if FORMATS[each[0]].choices("no_child")):
                files[path_of(spelling, profile, f"{name}_minus1")] = spelling, profile, {"no_child": -1}
        frozen = {
            path: Frozen(form_named(form), octree, options | ({"profile": profile} if profile else {}))
            for path, (form, profile, options) in files.items()
        }
        if name == "full_float32":
            frozen[f"octree/{name}.svo.pb.zst"] = Frozen(form_named("svo.pb"), octree, compressed=True)
        about = f"A sparse voxel octree, {octree.node_data.dtype}, {octree.layout} layout."
        yield Case(f"octree/{name}", about, frozen, facts_of(octree, LEVEL_SIZES.get(name, [1, 2, 3])), answer)


def path_of(name: str, profile: str | None, scene: str) -> str:
    return f"octree/{scene}{f'_{profile}' if profile else ''}.{name}"


def facts_of(octree: SparseVoxelOctree, level_sizes: list[int]) -> Facts:
    return {
        "size": list(octree.size),
        "layout": "compact" if len(octree.node_children) < len(octree.node_data) else "full",
        "data_format": octree.data_format,
        "data_dim": octree.node_data.shape[1],
        "dtype": str(octree.node_data.dtype),
        "level_sizes": level_sizes,
        "origin": floats(octree.origin),
        "voxel_size": floats(octree.voxel_size),
        "node_children": floats(octree.node_children),
        "node_data": floats(octree.node_data),
        "extra_data": floats(octree.extra_data),
        "lookups": [lookup_of(octree, place) for place in PLACES],
    }


def answer(path: Path, expected: Facts) -> Facts:
    octree = load(path, SparseVoxelOctree)
    points = np.array([each["point"] for each in expected["lookups"]])
    nearest, trilinear = octree.sample(points), octree.sample(points, lookup="trilinear")
    return {
        "size": list(octree.size),
        "layout": octree.layout,
        "data_format": octree.data_format,
        "data_dim": octree.data_dim,
        "dtype": str(octree.node_data.dtype),
        "level_sizes": octree.level_sizes,
        "origin": floats(octree.origin),
        "voxel_size": floats(octree.voxel_size),
        "node_children": floats(octree.node_children),
        "node_data": floats(octree.node_data),
        "extra_data": floats(octree.extra_data),
        "lookups": [
            {"point": p, "nearest": n, "trilinear": t}
            for p, n, t in zip(points.tolist(), nearest.tolist(), trilinear.tolist(), strict=True)
        ],
    }


# -- lookups, one voxel after the other ------------------------------------------------------------------------
def lookup_of(octree: SparseVoxelOctree, place: tuple[float, ...]) -> Facts:
    point = [float(o) + p * float(v) for o, p, v in zip(octree.origin, place, octree.voxel_size, strict=True)]
    trilinear = [0.0] * octree.node_data.shape[1]
    low = [math.floor(p - 0.5) for p in place]
    part = [p - 0.5 - start for p, start in zip(place, low, strict=True)]
    for corner in product((0, 1), repeat=3):
        weight = math.prod(f if c else 1 - f for c, f in zip(corner, part, strict=True))
        values = _values(octree, tuple(start + c for start, c in zip(low, corner, strict=True)))
        trilinear = [t + weight * v for t, v in zip(trilinear, values, strict=True)]
    nearest = _values(octree, tuple(math.floor(p) for p in place))
    return {"point": point, "nearest": nearest, "trilinear": trilinear}


def _values(octree: SparseVoxelOctree, voxel: Voxel) -> Row:
    """The values of the leaf that holds a voxel: down from the root, a bit of each coordinate a level."""
    nothing = [0.0] * octree.node_data.shape[1]
    if not all(0 <= v < edge for v, edge in zip(voxel, octree.size, strict=True)):
        return nothing
    row, edge = 0, 1
    while edge < max(octree.size):
        edge *= 2
    children = octree.node_children.tolist()
    while row < len(children) and any(children[row]):
        edge //= 2
        octant = sum(1 << axis for axis in range(3) if voxel[axis] & edge)
        row = children[row][octant]
        if row == 0:
            return nothing
    values: Row = octree.node_data[row].tolist()
    return values
