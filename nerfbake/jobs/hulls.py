"""Hulls of radiance fields, from files to files."""

from __future__ import annotations

from typing import Literal

import nerfbake
from nerfbake.jobs.files import AnySource, AnyTarget, as_source, as_target
from nerfbake.jobs.steps import SILENT, Steps

LEVEL = 5


def bake_hull(
    source: AnySource,
    target: AnyTarget,
    *,
    level: int = LEVEL,
    up: Literal["y", "z"] | None = None,
    steps: Steps = SILENT,
) -> nerfbake.Meshes:
    """Makes a mesh around all that can be seen of a PlenOctree, an octree or a volume, and gives what it wrote;
    `nerfbake hull` is this.

    Reads `source`, writes `target`. level: as build_hull() has it. up: of a .glb, the axis that points up in `source`;
    its nodes turn z to y; None: nothing is turned. Raises NerfbakeError.

    >>> print(bake_hull("a.npz", "hull.glb", level=2))
    mesh of 144 triangles over 74 vertices
    """
    source, target = as_source(source), as_target(target)
    target.require("Meshes", up=up)
    scene = source.read(steps, nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume)
    with source.blamed(steps, "building the hull"):
        meshes = nerfbake.build_hull(nerfbake.build_field(scene), level=level)
    target.write(steps, meshes, up=up)
    return meshes
