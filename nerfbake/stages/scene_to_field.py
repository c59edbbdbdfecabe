"""PlenOctree, octree, volume or field of bricks -> the field that a marcher reads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nerfbake.errors import UsageError
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.volume import Volume
from nerfbake.stages.brick_field_to_field import field_of_bricks
from nerfbake.stages.n3tree_to_field import field_of_n3tree
from nerfbake.stages.octree_to_field import field_of_octree
from nerfbake.stages.volume_to_field import field_of_volume

FieldSource = N3Tree | SparseVoxelOctree | Volume | BrickField
_STAGES: dict[type, Callable[[Any], RadianceField]] = {
    N3Tree: field_of_n3tree,
    SparseVoxelOctree: field_of_octree,
    Volume: field_of_volume,
    BrickField: field_of_bricks,
}


def build_field(scene: FieldSource) -> RadianceField:
    """The scene made ready for pictures, by the stage for its type; keep it for as long as pictures are made.

    Raises InvalidScene for what cannot be shown: broken scenes, SG and ASG bases, volumes without a density. Raises
    UsageError for what has no field.

    >>> from nerfbake import build_field, build_octree, sample_n3tree
    >>> tree = sample_n3tree(resolution=8)
    >>> print(build_field(tree))
    SH9 field of 167 leaves over 8^3 cells
    >>> print(build_field(build_octree(tree)))
    SH9 field of 167 leaves over 8^3 cells
    """
    if type(scene) not in _STAGES:
        known = ", ".join(kind.__name__ for kind in _STAGES)
        raise UsageError(f"{type(scene).__name__} has no radiance field; allowed: {known}")
    return _STAGES[type(scene)](scene)
