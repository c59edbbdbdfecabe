"""What DirectVoxGO's checkpoints hold beside their grids, which PlenVDB keeps in files of their own.

Keys: docs/formats/checkpoints.md. The grids of the optimiser's state, two more of each, are never looked at.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.torch_zip import TorchReader
from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.maths.elementary import log, power
from nerfbake.scene.lattice_field import Activation, Colour, LatticeField, MlpColour, RgbColour

_LEAST = 1e-4  # the opacity of a step below which its renderer skips a sample
# What other lattices than a box of the world's are told by, and what they are.
_REFUSED = {
    "mpi_depth": "a forward-facing scene (NDC), whose lattice is no box of the world",
    "scene_center": "an unbounded scene, whose lattice is contracted",
    "posbase_pe": "of DirectVoxGO before February 2022, whose MLP asks for positions",
}


class Model:
    """A checkpoint: its settings, and the arrays of the model's state by their keys."""

    def __init__(self, view: memoryview) -> None:
        self._file = TorchReader(view)
        self.settings, self.state = (_table(self._file.root, key) for key in ("model_kwargs", "model_state_dict"))
        for key, what in _REFUSED.items():
            if key in self.settings or (key == "posbase_pe" and "posfreq" in self.state):
                raise InvalidFile(Problem("model_kwargs", f"has {key}: {what}", "a bounded scene of DirectVoxGO"))

    def lattice(
        self, links: npt.NDArray[np.int32], density: Singles, features: npt.NDArray[Any], colour: Colour, dialect: str
    ) -> LatticeField:
        """The lattice of these nodes: links, density (n,) and features (n, C) as scene.lattice_field has them."""
        low, high = self.floats("xyz_min", (3,)), self.floats("xyz_max", (3,))
        return LatticeField(
            links=links,
            density=density,
            features=features,
            activation=Activation("softplus", self._shift(), 1 / self._voxel_size(low, high)),
            colour=colour,
            box=np.stack([low, high]),
            at_corners=True,
            occupied=self.mask(),
            least=_threshold(self.settings),
            dialect=dialect,
            notes=tuple(self._file.notes),
        )

    def any(self, key: str) -> npt.NDArray[Any]:
        if key not in self.state:
            there = ", ".join(str(each) for each in self.state if isinstance(each, str))
            raise InvalidFile(
                Problem("model_state_dict", f"has no {key}", f"a model of DirectVoxGO (has {there:.100})")
            )
        return self._file.array(self.state[key], key)

    def single(self, key: str) -> npt.NDArray[np.float32]:
        """Floats of any width as float32."""
        array = self.any(key)
        if array.dtype.kind != "f":
            raise InvalidFile(Problem(key, f"has dtype {array.dtype}", "floats"))
        if array.dtype != np.float32 or not array.flags.c_contiguous:
            memory.hold(key, 4 * array.size)
        return np.ascontiguousarray(cast(array, np.float32)).reshape(array.shape)

    def floats(self, key: str, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
        array = self.single(key)
        if array.shape != shape:
            raise InvalidFile(Problem(key, f"has shape {array.shape}", f"{shape}"))
        return cast(array, np.float64)

    def mask(self) -> Bits | None:
        """Where a sample counts that is nearest to it; None where the model says nothing of it."""
        if "mask_cache.mask" not in self.state:
            return None
        mask = self.any("mask_cache.mask")
        if mask.dtype != np.bool_ or mask.ndim != 3:
            found = f"has dtype {mask.dtype}, shape {mask.shape}"
            raise InvalidFile(Problem("mask_cache.mask", found, "bool (X, Y, Z)"))
        return mask

    def _shift(self) -> float:
        """What training left of it; before it was kept, what alpha_init makes."""
        if "act_shift" in self.state:
            return float(self.floats("act_shift", (1,))[0])
        alpha = self.settings.get("alpha_init")
        if type(alpha) is not float or not 0 < alpha < 1:
            raise InvalidFile(Problem("model_kwargs", "has no alpha_init, and the model no act_shift", "one of them"))
        return float(log(1 / (1 - alpha) - 1))

    def _voxel_size(self, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64]) -> float:
        """The edge of the voxel that opacities are reckoned with, in world units."""
        base = self._file.array(self.settings.get("num_voxels_base"), "num_voxels_base")
        if base.size != 1:
            raise InvalidFile(Problem("num_voxels_base", f"has shape {base.shape}", "one number"))
        count = float(base.reshape(-1)[0])
        for name, corner in (("xyz_min", low), ("xyz_max", high)):
            if not np.isfinite(corner).all():
                raise InvalidFile(Problem(name, f"is {corner}", "three finite numbers"))
        volume = float(np.prod(high - low))
        if not 1 <= count < 1 << 48 or not 0 < volume < np.inf:
            found = f"is {count:g}, over a volume of {volume:g}"
            raise InvalidFile(Problem("num_voxels_base", found, "1 or more, over a box with a volume"))
        return float(power(volume / count, 1 / 3))


def every_node(shape: tuple[int, ...]) -> npt.NDArray[np.int32]:
    """Links of a lattice that has a row for each node, x-major. Raises InvalidFile, MemoryLimit."""
    n = math.prod(shape)
    if n >= 1 << 31:
        raise InvalidFile(Problem("density", f"has {n:,} nodes", f"fewer than {1 << 31:,}"))
    memory.hold("links", 4 * n)
    return np.arange(n, dtype=np.int32).reshape(shape)


def _table(value: Any, key: str) -> dict[Any, Any]:
    found = value.get(key) if isinstance(value, dict) else None
    if not isinstance(found, dict):
        raise InvalidFile(Problem("data.pkl", f"has no {key}", "a checkpoint of DirectVoxGO"))
    return found


def _threshold(settings: dict[Any, Any]) -> float:
    """The opacity of a step below which a sample is skipped; of several by step of training, the last."""
    value = settings.get("fast_color_thres", _LEAST)
    if isinstance(value, dict) and value:
        value = value[max(value, key=lambda key: key if isinstance(key, int) else -1)]
    if type(value) not in (int, float) or not 0 <= value < 1:
        raise InvalidFile(Problem("fast_color_thres", "is no opacity", "0 to 1, without 1"))
    return float(value)


def colour_of(model: Model) -> Colour:
    """The MLP, or without one three channels that are colours themselves."""
    layers = sorted({int(key.split(".")[1]) for key in model.state if _is_layer(key)})
    if not layers:
        return RgbColour()
    if model.settings.get("rgbnet_full_implicit") is True:
        raise InvalidFile(Problem("model_kwargs", "has rgbnet_full_implicit: colours without a grid", "one with k0"))
    weights, biases = [], []
    for number in layers:
        stem = next(each for each in (f"rgbnet.{number}", f"rgbnet.{number}.0") if f"{each}.weight" in model.state)
        weights.append(model.single(f"{stem}.weight"))
        biases.append(model.single(f"{stem}.bias"))
    if len(layers) < 2 or weights[0].ndim != 2:
        found = f"has {len(layers)} layers, the first of {weights[0].shape}"
        raise InvalidFile(Problem("rgbnet", found, "two layers or more, of a matrix each"))
    H = len(weights[0])
    for number, weight, bias in list(zip(layers, weights, biases, strict=True))[1:-1]:
        if weight.shape != (H, H) or bias.shape != (H,):
            raise InvalidFile(Problem(f"rgbnet.{number}", f"has weights of {weight.shape}", f"({H}, {H}), as before"))
    frequencies = model.floats("viewfreq", (model.any("viewfreq").size,))
    return MlpColour(
        first=weights[0],
        first_bias=biases[0],
        middle=np.array(weights[1:-1], np.float32).reshape(len(layers) - 2, H, H),
        middle_bias=np.array(biases[1:-1], np.float32).reshape(len(layers) - 2, H),
        last=weights[-1],
        last_bias=biases[-1],
        frequencies=tuple(frequencies.tolist()),
        direct=model.settings.get("rgbnet_direct", False) is True,
    )


def _is_layer(key: Any) -> bool:
    """rgbnet.0.weight, rgbnet.2.0.weight, ..., rgbnet.3.weight."""
    match key.split(".") if isinstance(key, str) else []:
        case ["rgbnet", number, "weight"] | ["rgbnet", number, "0", "weight"]:
            return number.isascii() and number.isdecimal() and len(number) < 3
    return False
