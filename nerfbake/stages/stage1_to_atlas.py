"""nerf2mesh stage 1 -> baked atlases of all its cascades, with their errors."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.kernels.surface.octahedron import TexelLookup
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.atlas_to_error import AtlasError, measure_atlas_error
from nerfbake.stages.cameras_to_directions import weigh_directions
from nerfbake.stages.specular_to_atlas import bake_atlas

DirectionSet = Literal["fibonacci", "cameras"]
HELD_OUT = 617  # directions: a prime, so that the spiral meets none of the usual sets again

_BAKED = 0.75  # of the work is done when atlases are to be measured


def bake_stage1(
    stage1: Stage1,
    *,
    directions: int = 100,
    direction_set: DirectionSet = "fibonacci",
    **options: Any,
) -> BakedAtlas:
    """An atlas for each cascade, baked and measured in so many evenly spread directions; options go to bake_atlas().

    direction_set `cameras` lets each direction count as often as the training cameras look along it at the cascade's
    mesh; the errors stay evenly weighted. Raises InvalidScene where cameras or a mesh are missing for that.

    >>> from nerfbake import bake_stage1, sample_stage1
    >>> baked = bake_stage1(sample_stage1(resolution=16), directions=20, clusters=4, map_size=8)
    >>> print(baked.atlases[0])
    kmeans atlas of 4 maps of 8x8
    """
    evenly = fibonacci(directions)
    weights = _weights(stage1, direction_set, evenly)
    with progress.part(0, _BAKED):
        atlases = tuple(
            memory.kept(bake_atlas(field, directions=evenly, direction_weights=own, **options))
            for field, own in progress.each(list(zip(stage1.fields, weights, strict=True)))
        )
    with progress.part(_BAKED, 1):
        errors = [
            measure_atlas_error(atlas, field, directions=evenly)._asdict()
            for atlas, field in progress.each(list(zip(atlases, stage1.fields, strict=True)))
        ]
    facts = {"bake": {"directions": directions, "direction_set": direction_set, **options}, "errors": errors}
    return BakedAtlas(atlases, stage1.meshes, stage1.files, facts)


def _weights(
    stage1: Stage1, direction_set: DirectionSet, directions: npt.NDArray[np.float64]
) -> list[npt.NDArray[np.float64] | None]:
    """How much each direction counts, for each cascade; None where all count the same."""
    if direction_set == "fibonacci":
        return [None] * len(stage1.fields)
    if stage1.cameras is None:
        raise InvalidScene(Problem("transforms.json", "is missing", "one, with `direction_set=cameras`"))
    weights: list[npt.NDArray[np.float64] | None] = []
    for cascade, mesh in enumerate(stage1.meshes):
        if mesh is None:
            raise InvalidScene(Problem(f"mesh_{cascade}.obj", "is missing", "one, with `direction_set=cameras`"))
        weights.append(weigh_directions(mesh, stage1.cameras, directions))
    return weights


def measure_stage1_error(
    baked: BakedAtlas,
    stage1: Stage1,
    *,
    directions: int = 100,
    held_out: bool = False,
    lookup: TexelLookup = "bilinear",
    thesis_fault: bool = False,
) -> list[AtlasError]:
    """The error of each cascade's atlas. held_out: in directions that no bake has seen, instead of the baking ones.

    Raises InvalidScene if there are not as many atlases as cascades.

    >>> from nerfbake import bake_stage1, measure_stage1_error, sample_stage1
    >>> stage1 = sample_stage1(resolution=16)
    >>> (error,) = measure_stage1_error(bake_stage1(stage1, clusters=4, map_size=8), stage1, held_out=True)
    >>> error.texels == int(stage1.fields[0].used.sum())
    True
    """
    if len(baked.atlases) != len(stage1.fields):
        raise InvalidScene(
            Problem(
                "the atlas", f"has {len(baked.atlases)} cascades", f"{len(stage1.fields)} as the stage-1 folder has"
            )
        )
    asked = fibonacci(HELD_OUT if held_out else directions)
    return [
        measure_atlas_error(atlas, field, directions=asked, lookup=lookup, thesis_fault=thesis_fault)
        for atlas, field in zip(baked.atlases, stage1.fields, strict=True)
    ]
