"""fine_last.tar of PlenVDB's folder: what its program makes a model of before it reads the grids that stand beside it.

The program makes its model of `model_kwargs`, and takes `model_state_dict` only where it has the same keys as that
model: what dvgo_model.py reads of it, and the corners of the grids and the scale of the mask, which follow from it. How
many nodes there are the model works out of the box and of `num_voxels`: round down (edge of the box / v), with v^3 the
box's volume / num_voxels. Keys: docs/formats/checkpoints.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.wire.torch_writer import numpy_array, ordered, torch_file
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import exp, power
from nerfbake.scene.lattice_field import Colour, LatticeField, MlpColour, RgbColour

_WHOLE = 1e-9  # by which a number of voxels may miss a whole one, of itself
_CLEAR = 1e-4  # of a node: how far from the next whole number PlenVDB's own floats may not lead

Dictionary = dict[str, Any]


def model_file(lattice: LatticeField) -> bytes:
    """The file. Raises InvalidScene for a lattice that is none of PlenVDB's."""
    _require(lattice)
    low, high = lattice.box.astype(np.float32)
    mask = np.ones(lattice.shape, bool) if lattice.occupied is None else np.ascontiguousarray(lattice.occupied)
    scale = (np.array(mask.shape, np.float32) - 1) / (high - low)
    settings, layers = _colour(lattice.colour)
    state: Dictionary = {
        "xyz_min": low,
        "xyz_max": high,
        "act_shift": np.array([lattice.activation.shift], np.float32),
        "density.xyz_min": low,
        "density.xyz_max": high,
        "k0.xyz_min": low,
        "k0.xyz_max": high,
        **layers,
        "mask_cache.mask": mask,
        "mask_cache.xyz2ijk_scale": scale,
        "mask_cache.xyz2ijk_shift": -low * scale,
    }
    root = {
        "global_step": 0,
        "model_kwargs": {**_grids(lattice), **settings, "mask_cache_world_size": list(mask.shape)},
        "model_state_dict": ordered(state),
        "optimizer_state_dict": None,
        "time_recoder": [],
    }
    return torch_file(root, prefix="fine_last")


def _require(lattice: LatticeField) -> None:
    colour = lattice.colour
    if not isinstance(colour, MlpColour | RgbColour) or (isinstance(colour, MlpColour) and colour.encoded):
        raise InvalidScene(Problem("the lattice", f"has colours of {colour}", "an MLP of features and directions, RGB"))
    if colour.features % 3:
        raise InvalidScene(Problem("the lattice", f"has {colour.features} features", "a multiple of 3"))
    if lattice.activation.kind != "softplus" or not lattice.at_corners or lattice.mask_box is not None:
        found = f"is one of {lattice.dialect or 'another program'}"
        raise InvalidScene(Problem("the lattice", found, "softplus of raw densities, nodes and mask on one box"))


def _grids(lattice: LatticeField) -> Dictionary:
    """The settings that say where nodes stand and what their densities are reckoned with."""
    low, high = lattice.box.astype(np.float32)
    edges = high.astype(np.float64) - low
    volume, scale = float(np.prod(edges)), lattice.activation.scale
    base, count = volume * scale**3, _count(edges, lattice.shape)
    whole = round(base)
    return {
        "xyz_min": numpy_array(low),
        "xyz_max": numpy_array(high),
        "num_voxels": count,
        "num_voxels_base": whole if abs(base - whole) <= _WHOLE * base else base,
        "alpha_init": float(1 - 1 / (1 + exp(lattice.activation.shift))),
        "voxel_size_ratio": np.float32(float(power(volume / count, 1 / 3)) * scale),
        "mask_cache_path": None,
        "mask_cache_thres": 1e-3,
        "fast_color_thres": float(lattice.least),
        "density_type": "VDBGrid",
        "k0_type": "VDBGrid",
        "density_config": {},
        "k0_config": {},
    }


def _count(edges: Floats, shape: tuple[int, int, int]) -> int:
    """num_voxels: of those that stand for so many nodes along each axis one in the middle."""
    nodes = np.array(shape)
    v = np.sqrt(float((edges / (nodes + 1)).max()) * float((edges / nodes).min()))
    count = max(round(float(np.prod(edges)) / float(v) ** 3), 1)
    found = edges / float(power(float(np.prod(edges)) / count, 1 / 3))
    if not ((found >= nodes + _CLEAR) & (found <= nodes + 1 - _CLEAR)).all():
        told = "x".join(map(str, shape)), " x ".join(f"{edge:g}" for edge in edges)
        allowed = "nodes as far apart on each axis, no edge half as long as another"
        raise InvalidScene(Problem("the lattice", f"has {told[0]} nodes over {told[1]}", allowed))
    return count


def _colour(colour: Colour) -> tuple[Dictionary, Dictionary]:
    """The settings and the state of the MLP, which torch keeps as layers 0, 2, 3, ..., those between with a 0 behind
    their number."""
    if not isinstance(colour, MlpColour):
        return {"rgbnet_dim": 0}, {}
    depth = len(colour.middle) + 2
    settings = {
        "rgbnet_dim": colour.features,
        "rgbnet_direct": colour.direct,
        "rgbnet_full_implicit": False,
        "rgbnet_depth": depth,
        "rgbnet_width": len(colour.first),
        "viewbase_pe": len(colour.frequencies),
    }
    between = zip(colour.middle, colour.middle_bias, strict=True)
    layers = {"0": (colour.first, colour.first_bias)}
    layers |= {f"{number}.0": pair for number, pair in enumerate(between, 2)}
    layers[str(depth)] = colour.last, colour.last_bias
    state: Dictionary = {"viewfreq": np.array(colour.frequencies, np.float32)}
    for name, (weight, bias) in layers.items():
        state |= {f"rgbnet.{name}.weight": weight, f"rgbnet.{name}.bias": bias}
    return settings, state
