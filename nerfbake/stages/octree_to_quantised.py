"""Octree -> the whole numbers of a compressed file."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.stages._coefficients import Rows, transform, visible_leaves
from nerfbake.stages.field_to_importance import Importance


def quantise_octree(
    octree: SparseVoxelOctree, importance: Importance, *, step: float, prune: float = 0.0
) -> QuantisedOctree:
    """The leaves transformed and rounded to multiples of a step: docs/compression.md, "What is done".

    importance: of build_field(octree), by weigh_leaves(). prune: the share of leaves, the least important, that are
    left out, 0 to 1 (one always stays). step: of colour before the sigmoid, as the rays see it, in the root of its mean
    square. Raises InvalidScene for SG and ASG, broken octrees and those that hold nothing; MemoryLimit.

    >>> from nerfbake import build_field, build_octree, quantise_octree, sample_n3tree, sphere_cameras, weigh_leaves
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> field = build_field(octree)
    >>> importance = weigh_leaves(field, sphere_cameras(field, frames=8, edge=64))
    >>> print(quantise_octree(octree, importance, step=0.1, prune=0.2))
    SH9 octree of 16x16x16, 459 leaves, step 0.1
    """
    if not 0 <= prune <= 1:
        raise InvalidScene(Problem("prune", f"is {prune:g}", "a share of 0 to 1"))
    rows = visible_leaves(octree)
    keep = most_important(by_importance(importance), prune)
    return memory.kept(transform(octree, rows[keep], importance.gram).rounded(step))


def by_importance(importance: Importance) -> Rows:
    """The field's leaves, the least important first, of equal ones the first."""
    return np.argsort(importance.largest, kind="stable")


def most_important(order: Rows, prune: float) -> Rows:
    """Which of these leaves stay, in rising order, where this share goes, the first of them first."""
    stays = np.zeros(len(order), bool)
    stays[order[min(int(prune * len(order)), len(order) - 1) :]] = True
    return np.flatnonzero(stays)
