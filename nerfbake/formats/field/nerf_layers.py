"""The layers of NeRF's network, as several programs store them, in the order that scene.network expects.

All of them encode positions and directions by sines and cosines; they differ in the order of these inputs:

    x y z, then for each frequency: sines of x y z, cosines of x y z        "by frequency": nerf-pytorch
    x y z, then for each frequency: sines of x y z; then cosines likewise   "sines first": JaxNeRF
    sines of x, of y, of z; cosines likewise; then x y z                    "input last": nerfstudio
    for each of x y z: itself, its cosines, its sines                       "by coordinate": KiloNeRF

Source: docs/fields.md, "Programs".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.arrays import Ints, Points, Singles
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.maths.linear import product
from nerfbake.scene.network import MAX_LAYERS, MAX_UNITS, Frequencies, Mlp

MAX_FREQUENCIES = 16
Order = Literal["by frequency", "sines first", "input last", "by coordinate"]
_REACH = 3 / 8  # half the edge of the usual box, of far - near: 1.5 for the scenes of Blender, whose cameras are at 4


class Layer(NamedTuple):
    """A layer: its name in the file, weights (out, in) and biases (out,), float32."""

    name: str
    weight: Singles
    bias: Singles

    @property
    def inputs(self) -> int:
        return int(self.weight.shape[1])

    @property
    def outputs(self) -> int:
        return len(self.weight)

    def require_inputs(self, count: int) -> None:
        """Raise InvalidFile unless the layer takes this number of inputs."""
        if self.inputs != count:
            raise InvalidFile(Problem(self.name, f"takes {self.inputs} inputs", f"{count}"))

    def require_outputs(self, *counts: int) -> None:
        """Raise InvalidFile unless the layer has one of these numbers of outputs."""
        if self.outputs not in counts:
            raise InvalidFile(Problem(self.name, f"has {self.outputs} outputs", " or ".join(map(str, counts))))


def layer_names(keys: Iterable[Any], stem: str) -> list[str]:
    """Return `stem.0`, `stem.1` and so on up to the largest number that a key has, MAX_LAYERS at most."""
    numbers = [key.removeprefix(f"{stem}.").partition(".")[0] for key in keys if str(key).startswith(f"{stem}.")]
    known = [int(each) for each in numbers if each.isdecimal() and each.isascii() and len(each) < 3]
    return [f"{stem}.{k}" for k in range(min(max(known, default=-1), MAX_LAYERS) + 1)]


def layer_of(name: str, weight: Singles, bias: Singles) -> Layer:
    """Return the layer. Raises InvalidFile unless the shapes fit."""
    if weight.ndim != 2 or not 1 <= max(weight.shape) <= MAX_UNITS or bias.shape != weight.shape[:1]:
        found = f"has weights of shape {weight.shape} and biases of shape {bias.shape}"
        raise InvalidFile(Problem(name, found, f"(out, in) and (out,), {MAX_UNITS} at most"))
    memory.hold(name, 4 * weight.size)  # for a copy in another order
    return Layer(name, weight, bias)


def frequencies_in(layer: Layer, others: int = 0) -> int:
    """Return the number of frequencies of an encoding, from a layer that takes it beside `others` inputs."""
    count, rest = divmod(layer.inputs - others - 3, 6)
    if rest or not 0 <= count <= MAX_FREQUENCIES:
        found = f"takes {layer.inputs - others} inputs for a position or direction"
        raise InvalidFile(Problem(layer.name, found, f"3, and 6 for each of up to {MAX_FREQUENCIES} frequencies"))
    return count


def octaves(count: int, *, rounded: bool = False) -> Frequencies:
    """Return the frequencies 1, 2, 4 and so on."""
    return Frequencies((1 << np.arange(count)).astype(np.float64), rounded=rounded)


def columns_of(order: Order, frequencies: int) -> Ints:
    """(3 + 6 k,) the place in the file of each input of Frequencies: x y z, sines of x, of y, of z, cosines."""
    K = frequencies
    a, k = np.arange(3)[:, None], np.arange(K)
    if order == "by frequency":
        given, sines, cosines = np.arange(3), 3 + 6 * k + a, 6 + 6 * k + a
    elif order == "sines first":
        given, sines, cosines = np.arange(3), 3 + 3 * k + a, 3 + 3 * K + 3 * k + a
    elif order == "input last":
        given, sines, cosines = 6 * K + np.arange(3), a * K + k, 3 * K + a * K + k
    else:
        given, sines, cosines = np.arange(3) * (1 + 2 * K), a * (1 + 2 * K) + 1 + K + k, a * (1 + 2 * K) + 1 + k
    return np.concatenate([given, sines.reshape(-1), cosines.reshape(-1)]).astype(np.int64)


def trunk_of(layers: Sequence[Layer], order: Order, *, code_first: bool) -> Mlp:
    """Return the layers for positions, each followed by ReLU.

    A layer that takes the width of the one before plus that of the code takes both: code_first says which is first in
    the file. Raises InvalidFile.
    """
    if not 1 <= len(layers) <= MAX_LAYERS:
        raise InvalidFile(Problem("the network", f"has {len(layers)} layers for positions", f"1 to {MAX_LAYERS}"))
    columns = columns_of(order, frequencies_in(layers[0]))
    weights, skips = [layers[0].weight[:, columns]], []
    for k, (before, layer) in enumerate(pairwise(layers), start=1):
        if layer.inputs == before.outputs:
            weights.append(layer.weight)
            continue
        layer.require_inputs(before.outputs + len(columns))
        weights.append(after_features(layer, columns, code_first=code_first))
        skips.append(k)
    return Mlp(tuple(weights), tuple(layer.bias for layer in layers), tuple(skips), rectified=True)


def after_features(layer: Layer, columns: Ints, *, code_first: bool) -> Singles:
    """Return the weights of a layer of features and a code, for features first and the code in the common order."""
    features = layer.inputs - len(columns)
    parts = np.split(layer.weight, [len(columns) if code_first else features], axis=1)
    code, rest = parts if code_first else reversed(parts)
    return np.concatenate([rest, code[:, columns]], axis=1)


def folded(layer: Layer, weight: Singles, bottleneck: Layer) -> tuple[Singles, Singles]:
    """Return weights and biases of a layer that takes the inputs of the bottleneck, which has no ReLU, instead.

    weight: those of the layer, with the outputs of the bottleneck first.
    """
    width = bottleneck.outputs
    memory.hold(layer.name, 16 * bottleneck.weight.size)
    both = np.concatenate([cast(bottleneck.weight, np.float64), cast(bottleneck.bias, np.float64)[:, None]], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        own = product(cast(weight[:, :width], np.float64), both)
        bias = cast(own[:, -1] + layer.bias, np.float32)
    return np.concatenate([cast(own[:, :-1], np.float32), weight[:, width:]], axis=1), bias


def usual_box(near: float, far: float) -> Points:
    """(2, 3) the box around the origin in which the scene of such a capture usually is.

    Cameras look at the origin from (near + far) / 2. The wall that a program's last sample on each ray makes is at
    `far`, beyond (far - near) / 2 from the origin.
    """
    half = _REACH * (far - near)
    return np.array([[-half] * 3, [half] * 3])


def box_note(box: Any) -> str:
    """Return the note on a box that is assumed."""
    return f"the scene is assumed between -{box[1, 0]:g} and {box[1, 0]:g}; no density outside is used"


CORNER_NOTE = (
    "its rays go through the upper left corner of each pixel: to compare with its own pictures, "
    "give cameras whose cx and cy are half a pixel larger"
)
