"""nerf2mesh stage 1 -> baked atlases of all its cascades, with their errors."""

from __future__ import annotations

from typing import Any

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.octahedron import Lookup
from nerfbake.kernels.sphere import fibonacci
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.atlas_to_error import AtlasError, measure_error
from nerfbake.stages.specular_to_atlas import bake_atlas

HELD_OUT = 617  # directions: a prime, so that the spiral meets none of the usual sets again


def bake_stage1(
    stage1: Stage1,
    *,
    directions: int = 100,
    **options: Any,
) -> BakedAtlas:
    """An atlas for each cascade, baked and measured in so many evenly spread directions; options go to bake_atlas()."""
    evenly = fibonacci(directions)
    atlases = tuple(bake_atlas(field, directions=evenly, **options) for field in stage1.fields)
    errors = [
        measure_error(atlas, field, directions=evenly)._asdict()
        for atlas, field in zip(atlases, stage1.fields, strict=True)
    ]
    facts = {"bake": {"directions": directions, **options}, "errors": errors}
    return BakedAtlas(atlases, stage1.meshes, stage1.files, facts)


def measure_stage1(
    baked: BakedAtlas,
    stage1: Stage1,
    *,
    directions: int = 100,
    held_out: bool = False,
    lookup: Lookup = "bilinear",
    thesis_fault: bool = False,
) -> list[AtlasError]:
    """The error of each cascade's atlas. held_out: in directions that no bake has seen, instead of the baking ones.

    Raises InvalidScene if there are not as many atlases as cascades.
    """
    if len(baked.atlases) != len(stage1.fields):
        raise InvalidScene(
            Problem(
                "the atlas", f"has {len(baked.atlases)} cascades", f"{len(stage1.fields)} as the stage-1 folder has"
            )
        )
    asked = fibonacci(HELD_OUT if held_out else directions)
    return [
        measure_error(atlas, field, directions=asked, lookup=lookup, thesis_fault=thesis_fault)
        for atlas, field in zip(baked.atlases, stage1.fields, strict=True)
    ]
