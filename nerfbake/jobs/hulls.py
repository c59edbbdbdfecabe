"""Build hull meshes around radiance fields."""

from __future__ import annotations

from typing import Literal

from nerfbake.jobs.files import AnySource, AnyTarget, as_source, as_target, axis_option
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.mesh import Meshes
from nerfbake.stages.field_to_hull import build_hull

LEVEL = 5


def bake_hull(
    source: AnySource,
    target: AnyTarget,
    *,
    level: int = LEVEL,
    in_up: Literal["y", "z"] | None = None,
    functions: FunctionVoxels = FunctionVoxels(),
    steps: Steps = SILENT,
) -> Meshes:
    """Build a mesh that encloses everything visible in a field and return it. This is `nerfbake hull`.

    Reads `source`, any scene with a field; a scenery is enclosed, too, and splats keep their world. Writes `target`.
    Raises NerfbakeError.

    level  as in build_hull()
    in_up  for a .glb: the up axis of `source`; with z, the nodes rotate z to y; None: no rotation
    functions  how a trained field becomes voxels

    >>> print(bake_hull("a.npz", "hull.glb", level=2))
    mesh of 144 triangles over 74 vertices
    """
    source, target = as_source(source), as_target(target)
    options = axis_option(target.require("Meshes"), in_up)
    reading = Reading(steps, source, functions=functions)
    reading.require()
    reading.tell_scenery()
    field = reading.field()
    with source.blamed(steps, "building the hull"):
        meshes = build_hull(field, level=level)
    target.write(steps, meshes, **options)
    return meshes
