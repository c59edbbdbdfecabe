"""Lattice field -> facts about it, as plain numbers and text."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.kernels.maths.extremes import extremes
from nerfbake.scene.lattice_field import LatticeField


def summary_of_lattice(lattice: LatticeField) -> dict[str, Any]:
    """Its dialect, sizes, activation, colours, world box and ranges; JSON can hold it."""
    density, features = extremes(lattice.density[:, None]), extremes(lattice.features)
    kind, shift, scale = lattice.activation
    mask = lattice.occupied
    held = lattice.links >= 0
    blocks: dict[str, Any] = {}
    if lattice.blocks is not None:
        blocks = {"blocks": list(held.shape), "held_blocks": int(np.count_nonzero(held))}
        blocks["planes"] = None if lattice.planes is None else lattice.planes.density.shape[1]
    return {
        "kind": "lattice field",
        "dialect": lattice.dialect,
        "resolution": list(lattice.shape),
        "nodes": lattice.n,
        "linked_nodes": int(np.count_nonzero(held)) if lattice.blocks is None else lattice.n,
        **blocks,
        "mask": None if mask is None else list(mask.shape),
        "masked_nodes": None if mask is None else int(np.count_nonzero(mask)),
        "colours": str(lattice.colour),
        "dtype": lattice.features.dtype.name,
        "activation": {"kind": kind, "shift": float(shift), "scale": float(scale)},
        "nodes_at_corners": lattice.at_corners,
        "world_box": lattice.box.tolist() if np.isfinite(lattice.box).all() else None,
        "step": lattice.step if np.isfinite(lattice.step) else None,
        "ranges": {"density": density.range(), "features": features.range()},
        "non_finite": density.non_finite + features.non_finite,
        "notes": list(lattice.notes) or None,
        "bytes_in_memory": lattice.links.nbytes + lattice.density.nbytes + lattice.features.nbytes,
    }
