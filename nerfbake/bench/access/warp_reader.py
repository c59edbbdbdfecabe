# mypy: ignore-errors
# A kernel's annotations are Warp objects, not types.
"""Trilinear reads with a Warp kernel, compiled for one CPU core."""

# Warp evaluates the annotations as objects, so this module does not import annotations from __future__.
from collections.abc import Callable
from typing import Any

import warp as wp

wp.config.quiet = True


@wp.kernel
def trilinear(volume: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    """Read a float grid at points[i], in voxels, into out[i]."""
    i = wp.tid()
    out[i] = wp.volume_sample_f(volume, points[i], wp.Volume.LINEAR)


def launcher(grid: bytes, points: Any, out: Any) -> Callable[[], None]:
    """Return a function that reads a .nvdb file's bytes at points (n, 3) float32 into out (n,) float32."""
    volume = wp.Volume.load_from_nvdb(grid, device="cpu")
    places = wp.array(points, dtype=wp.vec3, device="cpu", copy=False)
    values = wp.array(out, dtype=wp.float32, device="cpu", copy=False)
    return lambda: wp.launch(trilinear, len(points), inputs=[volume.id, places], outputs=[values], device="cpu")
