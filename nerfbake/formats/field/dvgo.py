"""DirectVoxGO's checkpoint (fine_last.tar, coarse_last.tar), a file of torch's. Keys: docs/formats/checkpoints.md.

The grids of the optimiser's state, two more of each, are never looked at.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.torch_zip import TorchReader, is_torch
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.maths.elementary import log, power
from nerfbake.scene.lattice_field import Activation, Colour, LatticeField, MlpColour, RgbColour

_HEAD = 1 << 20  # bytes that the pickle is in, which stands first
_LEAST = 1e-4  # the opacity of a step below which its renderer skips a sample
# What other lattices than a box of the world's are told by, and what they are.
_REFUSED = {
    "mpi_depth": "a forward-facing scene (NDC), whose lattice is no box of the world",
    "scene_center": "an unbounded scene, whose lattice is contracted",
    "posbase_pe": "of DirectVoxGO before February 2022, whose MLP asks for positions",
}


def recognise(view: memoryview) -> bool:
    """True for a file of torch's with the settings that this program keeps."""
    return is_torch(view) and b"model_kwargs" in bytes(view[:_HEAD])


def decode(view: memoryview) -> LatticeField:
    """The lattice of a checkpoint."""
    file = TorchReader(view)
    settings, state = _table(file.root, "model_kwargs"), _table(file.root, "model_state_dict")
    for key, what in _REFUSED.items():
        if key in settings or (key == "posbase_pe" and "posfreq" in state):
            raise InvalidFile(Problem("model_kwargs", f"has {key}: {what}", "a bounded scene of DirectVoxGO"))
    reader = _Values(file, state)
    density = reader.grid("density", 1)
    shape = density.shape[1:]
    colour = _colour(reader, settings)
    features = _features(reader, settings, colour, shape)
    low, high = reader.floats("xyz_min", (3,)), reader.floats("xyz_max", (3,))
    n = density.size
    if n >= 1 << 31:
        raise InvalidFile(Problem("density", f"has {n:,} nodes", f"fewer than {1 << 31:,}"))
    memory.hold("links", 4 * n)
    mask = reader.any("mask_cache.mask") if "mask_cache.mask" in state else None
    if mask is not None and (mask.dtype != np.bool_ or mask.ndim != 3):
        raise InvalidFile(Problem("mask_cache.mask", f"has dtype {mask.dtype}, shape {mask.shape}", "bool (X, Y, Z)"))
    return LatticeField(
        links=np.arange(n, dtype=np.int32).reshape(shape),
        density=density.reshape(-1),
        features=features,
        activation=Activation("softplus", _shift(reader, settings), 1 / _voxel_size(file, settings, low, high)),
        colour=colour,
        box=np.stack([low, high]),
        at_corners=True,
        occupied=mask,
        least=_threshold(settings),
        dialect="DirectVoxGO" if "density.grid" in state else "DirectVoxGO, early 2022",
        notes=tuple(file.notes),
    )


class _Values:
    """The arrays of a model's state by their keys."""

    def __init__(self, file: TorchReader, state: dict[Any, Any]) -> None:
        self._file, self.state = file, state

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

    def grid(self, name: str, channels: int | None) -> npt.NDArray[np.float32]:
        """(C, X, Y, Z) of name.grid, or of name alone, as it was before April 2022."""
        key = name if name in self.state and f"{name}.grid" not in self.state else f"{name}.grid"
        array = self.single(key)
        if array.ndim != 5 or array.shape[0] != 1 or array.shape[1] != (channels or array.shape[1]):
            allowed = f"(1, {channels or 'C'}, X, Y, Z)"
            raise InvalidFile(Problem(key, f"has shape {array.shape}", allowed))
        found: npt.NDArray[np.float32] = array[0]
        return found


def _table(value: Any, key: str) -> dict[Any, Any]:
    found = value.get(key) if isinstance(value, dict) else None
    if not isinstance(found, dict):
        raise InvalidFile(Problem("data.pkl", f"has no {key}", "a checkpoint of DirectVoxGO"))
    return found


def _features(
    reader: _Values, settings: dict[Any, Any], colour: Colour, shape: tuple[int, ...]
) -> npt.NDArray[np.float32]:
    """(n, C), each channel lying together as in the file."""
    if "k0.xy_plane" in reader.state:
        raise InvalidFile(Problem("k0", "is of planes and vectors (TensoRFGrid)", "a DenseGrid"))
    grid = reader.grid("k0", colour.features)
    if grid.shape[1:] != shape:
        raise InvalidFile(Problem("k0", f"has {grid.shape[1:]} nodes", f"{shape}, as density has"))
    return grid.reshape(colour.features, -1).T


def _number(file: TorchReader, value: Any, name: str) -> float:
    array = file.array(value, name)
    if array.size != 1:
        raise InvalidFile(Problem(name, f"has shape {array.shape}", "one number"))
    return float(array.reshape(-1)[0])


def _shift(reader: _Values, settings: dict[Any, Any]) -> float:
    """What training left of it; before it was kept, what alpha_init makes."""
    if "act_shift" in reader.state:
        return float(reader.floats("act_shift", (1,))[0])
    alpha = settings.get("alpha_init")
    if type(alpha) is not float or not 0 < alpha < 1:
        raise InvalidFile(Problem("model_kwargs", "has no alpha_init, and the model no act_shift", "one of them"))
    return float(log(1 / (1 - alpha) - 1))


def _voxel_size(
    file: TorchReader, settings: dict[Any, Any], low: npt.NDArray[np.float64], high: npt.NDArray[np.float64]
) -> float:
    """The edge of the voxel that opacities are reckoned with, in world units."""
    count = _number(file, settings.get("num_voxels_base"), "num_voxels_base")
    for name, corner in (("xyz_min", low), ("xyz_max", high)):
        if not np.isfinite(corner).all():
            raise InvalidFile(Problem(name, f"is {corner}", "three finite numbers"))
    volume = float(np.prod(high - low))
    if not 1 <= count < 1 << 48 or not 0 < volume < np.inf:
        found = f"is {count:g}, over a volume of {volume:g}"
        raise InvalidFile(Problem("num_voxels_base", found, "1 or more, over a box with a volume"))
    return float(power(volume / count, 1 / 3))


def _threshold(settings: dict[Any, Any]) -> float:
    """The opacity of a step below which a sample is skipped; of several by step of training, the last."""
    value = settings.get("fast_color_thres", _LEAST)
    if isinstance(value, dict) and value:
        value = value[max(value, key=lambda key: key if isinstance(key, int) else -1)]
    if type(value) not in (int, float) or not 0 <= value < 1:
        raise InvalidFile(Problem("fast_color_thres", "is no opacity", "0 to 1, without 1"))
    return float(value)


def _colour(reader: _Values, settings: dict[Any, Any]) -> Colour:
    """The MLP, or without one three channels that are colours themselves."""
    layers = sorted({int(key.split(".")[1]) for key in reader.state if _is_layer(key)})
    if not layers:
        return RgbColour()
    if settings.get("rgbnet_full_implicit") is True:
        raise InvalidFile(Problem("model_kwargs", "has rgbnet_full_implicit: colours without a grid", "one with k0"))
    weights, biases = [], []
    for number in layers:
        stem = next(each for each in (f"rgbnet.{number}", f"rgbnet.{number}.0") if f"{each}.weight" in reader.state)
        weights.append(reader.single(f"{stem}.weight"))
        biases.append(reader.single(f"{stem}.bias"))
    if len(layers) < 2 or weights[0].ndim != 2:
        found = f"has {len(layers)} layers, the first of {weights[0].shape}"
        raise InvalidFile(Problem("rgbnet", found, "two layers or more, of a matrix each"))
    H = len(weights[0])
    for number, weight, bias in list(zip(layers, weights, biases, strict=True))[1:-1]:
        if weight.shape != (H, H) or bias.shape != (H,):
            raise InvalidFile(Problem(f"rgbnet.{number}", f"has weights of {weight.shape}", f"({H}, {H}), as before"))
    frequencies = reader.floats("viewfreq", (reader.any("viewfreq").size,))
    return MlpColour(
        first=weights[0],
        first_bias=biases[0],
        middle=np.array(weights[1:-1], np.float32).reshape(len(layers) - 2, H, H),
        middle_bias=np.array(biases[1:-1], np.float32).reshape(len(layers) - 2, H),
        last=weights[-1],
        last_bias=biases[-1],
        frequencies=tuple(frequencies.tolist()),
        direct=settings.get("rgbnet_direct", False) is True,
    )


def _is_layer(key: Any) -> bool:
    """rgbnet.0.weight, rgbnet.2.0.weight, ..., rgbnet.3.weight."""
    match key.split(".") if isinstance(key, str) else []:
        case ["rgbnet", number, "weight"] | ["rgbnet", number, "0", "weight"]:
            return number.isascii() and number.isdecimal() and len(number) < 3
    return False
