"""Asking for memory ahead of time: values stay as they are, and kernels still run as plain Python."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.march.traversal import SINGLES, prefetch

# Nine pixels of a small scene, and how opaque they are together.
PLAIN = """
from nerfbake import build_field, orbit_cameras, render_field, sample_n3tree
field = build_field(sample_n3tree(resolution=8))
print(f"{render_field(field, orbit_cameras(field, width=3, height=3).cameras[0]).alpha.sum():.3f}")
"""


@compiled()
def everywhere(values: Singles) -> None:
    for row in range(len(values)):
        for column in range(values.shape[1]):
            prefetch(values, row, column)


def test_values_stay() -> None:
    values = np.arange(5 * (SINGLES + 3), dtype=np.float32).reshape(5, -1)
    everywhere(values)
    assert_array_equal(values.reshape(-1), np.arange(values.size))
    everywhere(np.empty((0, 4), np.float32))


@pytest.mark.long
def test_a_picture_is_made_without_the_compiler_too() -> None:
    said = [
        subprocess.run([sys.executable, "-c", PLAIN], env=os.environ | more, check=True, capture_output=True).stdout
        for more in ({}, {"NUMBA_DISABLE_JIT": "1"})
    ]
    assert said[0] == said[1]
    assert float(said[0]) > 0.5
