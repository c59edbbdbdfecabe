from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import cast_volume
from nerfbake.errors import InvalidScene
from tests.support.vdb_readers import SCENES, index, tree, volume


def test_values_are_rounded_to_halves_and_widened_again() -> None:
    made = volume(tree(SCENES["a cloud"], background=0.1))
    half = cast_volume(made, dtype="float16").grids[0]
    assert half.values.dtype == np.float16
    assert_array_equal(half.values, made.grids[0].values.astype(np.float16))
    assert half.background.tolist() == [np.float32(np.float16(0.1))]
    wide = cast_volume(volume(half), dtype="float32").grids[0]
    assert wide.values.dtype == np.float32
    assert_array_equal(wide.values, half.values.astype(np.float32))


def test_the_table_of_an_index_is_made_narrower_but_not_wider() -> None:
    made = volume(index(SCENES["a full leaf"]))
    half = cast_volume(made, dtype="float16")
    assert half.grids[0].values.dtype == np.float16
    assert cast_volume(half, dtype="float32").grids[0].values.dtype == np.float16


def test_what_no_half_holds_is_refused_by_its_grids_name() -> None:
    with pytest.raises(InvalidScene, match="grid 'density'"):
        cast_volume(volume(tree(SCENES["one voxel"], background=1e6)), dtype="float16")
