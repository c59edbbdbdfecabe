"""Warp kernels that look up the value or the index of a voxel."""

# No `from __future__ import annotations`: Warp reads the annotations as objects.
from typing import Any

import warp as wp

wp.config.quiet = True


@wp.kernel
def floats(volume: wp.uint64, places: wp.array(dtype=wp.vec3i), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = wp.volume_lookup_f(volume, places[i][0], places[i][1], places[i][2])


@wp.kernel
def vectors(volume: wp.uint64, places: wp.array(dtype=wp.vec3i), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = wp.volume_lookup_v(volume, places[i][0], places[i][1], places[i][2])


@wp.kernel
def rows(volume: wp.uint64, places: wp.array(dtype=wp.vec3i), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = wp.volume_lookup_index(volume, places[i][0], places[i][1], places[i][2])


LOOKUPS: dict[str, Any] = {"Float": floats, "Vec3f": vectors, "OnIndex": rows}
