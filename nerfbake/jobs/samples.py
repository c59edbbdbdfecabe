"""Synthetic scenes as files, to try things out without a download."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nerfbake
from nerfbake.jobs.files import AnyTarget, FolderTarget, as_target
from nerfbake.jobs.steps import SILENT, Steps


def write_sample_n3tree(target: AnyTarget, *, steps: Steps = SILENT, **options: Any) -> nerfbake.N3Tree:
    """Writes a PlenOctree of shiny shapes, and gives it; `nerfbake sample octree`.

    Reads nothing, writes `target`. Options go to sample_n3tree(). Raises NerfbakeError.

    >>> write_sample_n3tree("small.npz", resolution=16).resolution
    16
    """
    target = as_target(target)
    target.require("N3Tree")
    with steps.phase("growing the tree"):
        tree = nerfbake.sample_n3tree(**options)
    target.write(steps, tree)
    return tree


def write_sample_stage1(target: FolderTarget | str | Path, *, steps: Steps = SILENT, **options: Any) -> nerfbake.Stage1:
    """Writes a stage-1 folder of nerf2mesh with a glossy torus, and gives it; `nerfbake sample nerf2mesh`.

    Reads nothing, writes the folder `target`. Options go to sample_stage1(). Raises NerfbakeError.

    >>> len(write_sample_stage1("torus", resolution=64).fields)
    1
    """
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require()
    with steps.phase("fitting the MLP"):
        scene = nerfbake.sample_stage1(**options)
    sizes = target.write(steps, scene)
    steps.say(f"{target.path}: {scene}, {sum(sizes.values()):,} bytes")
    return scene
