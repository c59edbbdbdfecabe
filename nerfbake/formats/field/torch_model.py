"""Read the settings and the model state of checkpoints that torch wrote."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.torch import TorchReader
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.maths.elementary import cast


class MlpLayers(NamedTuple):
    """The first six fields of scene.lattice_field.MlpColour."""

    first: Singles
    first_bias: Singles
    middle: Singles
    middle_bias: Singles
    last: Singles
    last_bias: Singles


class TorchModel:
    """A program's checkpoint; `settings` and `state` are the keys of these two tables in the file."""

    def __init__(self, view: memoryview, settings: str, state: str, program: str) -> None:
        self.file = TorchReader(view)
        self.program, self._place = program, state
        self.settings, self.state = self._table(settings), self._table(state)

    def _table(self, key: str) -> dict[Any, Any]:
        root = self.file.root
        found = root.get(key) if isinstance(root, dict) else None
        if not isinstance(found, dict):
            raise InvalidFile(Problem("data.pkl", f"has no {key}", f"a checkpoint of {self.program}"))
        return found

    def any(self, key: str) -> npt.NDArray[Any]:
        if key not in self.state:
            there = ", ".join(str(each) for each in self.state if isinstance(each, str))
            allowed = f"a model of {self.program} (has {there:.100})"
            raise InvalidFile(Problem(self._place, f"has no {key}", allowed))
        return self.file.array(self.state[key], key)

    def single(self, key: str) -> Singles:
        """Return an array of floats of any width as float32."""
        return as_singles(self.any(key), key)

    def floats(self, key: str, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
        array = self.single(key)
        if array.shape != shape:
            raise InvalidFile(Problem(key, f"has shape {array.shape}", f"{shape}"))
        return cast(array, np.float64)

    def layers(self, stems: list[str], names: list[str]) -> tuple[dict[str, Singles], dict[str, Singles]]:
        """Return the weights and biases of torch's Linear layers, by the names that error messages use."""
        weights = {name: self.single(f"{stem}.weight") for name, stem in zip(names, stems, strict=True)}
        return weights, {name: self.single(f"{stem}.bias") for name, stem in zip(names, stems, strict=True)}


def as_singles(array: npt.NDArray[Any], name: str) -> Singles:
    """Convert floats of any width to contiguous float32. Raises InvalidFile for other dtypes."""
    if array.dtype.kind != "f":
        raise InvalidFile(Problem(name, f"has dtype {array.dtype}", "floats"))
    if array.dtype != np.float32 or not array.flags.c_contiguous:
        memory.hold(name, 4 * array.size)
    return np.ascontiguousarray(cast(array, np.float32)).reshape(array.shape)


def format_setting(value: Any) -> str:
    """Format a setting for an error message. Only the type is shown for containers, which may be of any size."""
    if isinstance(value, str | int | float | bool | None):
        return repr(value)[:40]
    return f"a {type(value).__name__.lower()}"


def layers_of(weights: dict[str, Singles], biases: dict[str, Singles]) -> MlpLayers:
    """Stack the layers by name and in order: weights (out, in), biases (out,). Raises InvalidFile."""
    names = list(weights)
    if len(names) < 2 or weights[names[0]].ndim != 2:
        found = f"has {len(names)} layers, the first of shape {weights[names[0]].shape}"
        raise InvalidFile(Problem(names[0].partition(".")[0], found, "two or more layers, each a matrix"))
    first, *between, last = names
    H = len(weights[first])
    for name in between:
        if weights[name].shape != (H, H) or biases[name].shape != (H,):
            raise InvalidFile(
                Problem(name, f"has weights of {weights[name].shape}", f"({H}, {H}), as the previous layer")
            )
    middle = np.array([weights[name] for name in between], np.float32).reshape(len(between), H, H)
    middle_bias = np.array([biases[name] for name in between], np.float32).reshape(len(between), H)
    return MlpLayers(weights[first], biases[first], middle, middle_bias, weights[last], biases[last])


def every_node(shape: tuple[int, ...]) -> npt.NDArray[np.int32]:
    """Return the links of a lattice with one row for each node, x-major. Raises InvalidFile, MemoryLimit."""
    n = math.prod(shape)
    if n >= 1 << 31:
        raise InvalidFile(Problem("density", f"has {n:,} nodes", f"fewer than {1 << 31:,}"))
    memory.hold("links", 4 * n)
    return np.arange(n, dtype=np.int32).reshape(shape)
