from __future__ import annotations

import numpy as np
import pytest

from nerfbake import build_octree, sample_n3tree
from nerfbake.errors import InvalidScene


@pytest.mark.parametrize("basis", ["SH1", "SH4", "SH9", "SH16", "SH25"])
def test_a_sample_is_sound_in_every_basis(basis: str) -> None:
    tree = sample_n3tree(resolution=16, basis=basis)
    assert tree.problems() == []
    assert (tree.resolution, tree.data_format) == (16, basis)
    assert build_octree(tree).problems() == []


def test_a_sample_has_leaves_at_several_depths_and_empty_space() -> None:
    tree = sample_n3tree(resolution=64)
    leaves = tree.leaf_mask
    occupied = leaves & (tree.data[..., -1] > 0)
    depths = [int(occupied[rows].sum()) for rows in tree.levels]
    assert sum(count > 0 for count in depths) >= 3
    assert 0.1 < occupied.sum() / leaves.sum() < 0.9


def test_colours_change_with_the_direction_only_on_glossy_shapes() -> None:
    tree = sample_n3tree(resolution=64)
    floor, torus = tree.sample([[0.9, -0.9, -0.9], [0.62, 0, -0.06]])
    for values, glossy in ((floor, False), (torus, True)):
        assert values[-1] > 0
        assert bool(np.abs(values[:-1].reshape(3, 9)[:, 1:]).max() > 0.1) == glossy


def test_the_seed_decides() -> None:
    a, b, other = (sample_n3tree(resolution=16, seed=seed) for seed in (1, 1, 2))
    assert a.data.tobytes() == b.data.tobytes()
    assert a.child.tobytes() == b.child.tobytes()
    assert a.data.tobytes() != other.data.tobytes()


@pytest.mark.parametrize("wrong", [{"resolution": 100}, {"resolution": 2}, {"basis": "RGBA"}, {"basis": "SH10"}])
def test_what_cannot_be_made_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidScene, match="allowed"):
        sample_n3tree(**wrong)  # type: ignore[arg-type]
