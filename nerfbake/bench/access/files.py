"""The size of every file that could be written of a scene at one resolution."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

from nerfbake import io
from nerfbake.errors import InvalidScene, NerfbakeError
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import Volume
from nerfbake.stages.octree_to_vdb import build_vdb

COLUMNS = ["file", "R", "MB"]


def file_rows(folder: Path, R: int, tree: SparseVoxelOctree, density: Volume, index: Volume) -> list[list[Any]]:
    """The size of each, or why it could not be written: formats have limits, and float16 does not hold every scene."""
    path = folder / "file"

    def row(what: str, scene: Any, to: str, **options: Any) -> list[Any]:
        try:
            return [what, R, io.save(path, scene, to=to, force=True, **options) / 1e6]
        except NerfbakeError as error:
            return [f"{what}: {error.line.removeprefix(f'{path}: ')}", R, None]

    rows = [row(f"octree .{to}", tree, to) for to in ("svo.npz", "svo.pb")]
    for what, volume, endings in (("density", density, ("nvdb", "vdb")), ("index", index, ("nvdb",))):
        try:
            half = build_vdb(tree, grids=(what,), half=True)
        except InvalidScene as error:
            rows.append([f"{what} half: {error.line}", R, None])
            half = None
        for to, codec in product(endings, ("none", "zip")):
            packed = " zip" if codec == "zip" else ""
            rows.append(row(f"{what} .{to}{packed}", volume, to, codec=codec))
            if half:
                rows.append(row(f"{what} .{to} half{packed}", half, to, codec=codec))
    return rows
