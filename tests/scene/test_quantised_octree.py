from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nerfbake.errors import InvalidScene
from nerfbake.scene.quantised_octree import MAX_VALUE, QuantisedOctree


def quantised(masks: list[int], m: int, edge: int = 4) -> QuantisedOctree:
    return QuantisedOctree(
        size=(edge, edge, edge),
        masks=np.array(masks, np.uint8),
        values=np.zeros((m, 4), np.int32),
        mixing=np.eye(3, dtype=np.int16),
        mixing_scale=1.0,
        colour_step=0.1,
        density_step=0.2,
        density_scale=20.0,
        data_format="SH1",
    )


def test_leaves_of_every_depth_by_hand() -> None:
    # A leaf in octant 0 of the root and a node in octant 1 with two voxels.
    octree = quantised([0b11, 0, 0b10000001], 3)
    assert octree.level_sizes == [1, 2, 2]
    assert octree.problems() == []
    assert str(octree) == "SH1 octree of 4x4x4, 3 leaves, step 0.1"


def test_one_voxel_needs_no_mask() -> None:
    assert quantised([], 1, edge=1).problems() == []


@pytest.mark.parametrize("masks", [[], [0b11, 0], [0b11, 0, 1, 1], [0b11, 255, 255, 0]])
def test_masks_that_speak_of_more_or_fewer_nodes_are_told(masks: list[int]) -> None:
    assert [problem.place for problem in quantised(masks, 3).problems()] == ["masks"]


def test_rows_that_no_leaf_has_are_told() -> None:
    assert [problem.place for problem in quantised([0b11, 0, 1], 3).problems()] == ["values"]


def test_coefficients_out_of_bounds_are_told() -> None:
    octree = quantised([0], 1)
    octree.values[0, 0] = -MAX_VALUE - 1
    assert [problem.place for problem in octree.problems()] == ["values"]


def test_densities_that_float64_cannot_hold_are_infinite_and_told() -> None:
    octree = replace(quantised([0], 1), density_step=1e9)
    octree.values[0, -1] = 1
    restored = octree.restored()
    assert np.isposinf(restored.node_data[0, -1])
    assert [problem.place for problem in restored.problems()] == ["node_data[0, 3]"]


@pytest.mark.parametrize("field", ["mixing_scale", "colour_step", "density_step", "density_scale"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_steps_that_are_none_are_refused(field: str, value: float) -> None:
    fields: dict[str, Any] = {field: value}
    with pytest.raises(InvalidScene, match=field):
        replace(quantised([0], 1), **fields)
