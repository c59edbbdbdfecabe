"""The facts of a trained field, for scene_to_summary."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake import memory
from nerfbake.scene.function_field import FunctionField


def summary_of_function(field: FunctionField) -> dict[str, Any]:
    """Return the dialect, the network, its numbers, the boxes, the background and the cameras, as JSON types."""
    background = field.background
    return {
        "kind": "trained field",
        "dialect": field.dialect,
        "network": str(field.network),
        "numbers": field.network.numbers,
        "contracted": field.contracted,
        "world_box": field.world_box.tolist() if not field.structure_problems() else None,
        "trained_box": field.box.tolist() if np.isfinite(field.box).all() else None,
        "scale": field.scale if np.isfinite(field.scale) else None,
        "near": field.near if np.isfinite(field.near) else None,
        "far": field.far if np.isfinite(field.far) else None,
        "background": list(background) if isinstance(background, tuple) else background,
        "occupancy": None if field.occupied is None else list(field.occupied.cells.shape),
        "cameras": None if field.cameras is None else len(field.cameras.cameras),
        "notes": list(field.notes) or None,
        "bytes_in_memory": memory.size_of(field.network),
    }
