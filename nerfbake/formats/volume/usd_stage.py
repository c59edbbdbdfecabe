"""Volumes as a stage of USD beside a .vdb, which the writers of both containers share.

    Xform "scene"
        Volume "volume"                             extent: the box of all active voxels
            rel field:density -> OpenVDBAsset "density"
                asset filePath                      ./NAME.vdb
                token fieldName                     the name of the grid in it

Coordinates in the .vdb are those of the stage, so that upAxis is the up axis of the grids.
Source: OpenUSD 26.11, usdVol/schema.usda.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.wire.usd.stage import Attribute, Prim, Relationship, UsdStage, prim_names
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import transform_points
from nerfbake.scene.volume import Volume

VDB = ".vdb"
_PATH = "/scene/volume"


def volume_stage(volume: Volume, stem: str, *, up: Literal["y", "z"]) -> UsdStage:
    """Return the stage of a volume whose grids are in the file `stem`.vdb. Raises InvalidScene."""
    labels = [grid.name for grid in volume.grids]
    if not all(labels) or len(set(labels)) < len(labels):
        raise InvalidScene(Problem("the volume", f"has the grids {', '.join(volume.labels)}", "each name once"))
    names = list(prim_names(labels, default="grid"))
    fields = tuple(
        Prim(
            name,
            "OpenVDBAsset",
            {
                "filePath": Attribute("asset", f"./{stem}{VDB}"),
                "fieldName": Attribute("token", label),
            },
        )
        for name, label in zip(names, labels, strict=True)
    )
    properties: dict[str, Attribute | Relationship] = {"extent": Attribute("float3[]", _extent(volume))}
    properties |= {f"field:{name}": Relationship((f"{_PATH}/{name}",)) for name in names}
    return UsdStage(
        Prim("scene", "Xform", children=(Prim("volume", "Volume", properties, fields),)), "Z" if up == "z" else "Y"
    )


def refused() -> InvalidScene:
    """The error for a stage without a .vdb beside it."""
    return InvalidScene(Problem("the volume", "needs a .vdb beside the stage", "a file on the disk, or .vdb"))


def _extent(volume: Volume) -> Floats:
    """(2, 3) the box of the active voxels and tiles of all grids."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for grid in volume.grids:
        box = grid.topology.box
        if box is not None:
            sides = zip(box[0] - 0.5, box[1] + 0.5, strict=True)  # a voxel's centre has whole coordinates
            ends = np.array(np.meshgrid(*sides)).reshape(3, -1).T
            corners = transform_points(ends, volume.transform_of(grid))
            low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    return np.stack([low, high]) if np.isfinite(low).all() else np.zeros((2, 3))  # USD has no empty extent
