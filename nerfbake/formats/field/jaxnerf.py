"""Read checkpoints of JaxNeRF, and of NeRF-SH and NeRF-SG, which the PlenOctrees came from: `checkpoint_STEP`.

    {"optimizer": {"target": {"params": {             MessagePack, as flax writes it
        "MLP_0": coarse, "MLP_1": fine:               the fine one is used if it exists
            {"Dense_0": {"kernel": (in, out), "bias": (out)}, ...},
        "sg_lambda": (n), "sg_mu_spher": (n, 2)}},    NeRF-SG: sharpness before softplus; polar angle from z, azimuth
     "state": ...}}                                   the optimiser's, which is never read

    Dense_0 .. 7    the encoded position; layer 5 also takes it, behind the features
    Dense_8         density, per world unit, before ReLU
    Dense_9         without view directions: colour, or its coefficients of red, of green, of blue
    Dense_9 .. 11   with them: a layer without ReLU; [features, encoded direction]; colour

Colours are before the sigmoid. Coefficients of NeRF-SH are those of the octrees' spherical harmonics. The order of the
encoding, depths and the background are only in the run's YAML file; it is read if it lies beside the checkpoint.

Source: docs/fields.md, "Programs".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.nerf_layers import (
    CORNER_NOTE,
    Layer,
    Order,
    after_features,
    box_note,
    columns_of,
    folded,
    frequencies_in,
    layer_names,
    layer_of,
    octaves,
    trunk_of,
    usual_box,
)
from nerfbake.formats.field.torch_model import as_singles
from nerfbake.formats.field.yaml_beside import YamlBeside
from nerfbake.formats.wire.msgpack import parse_map
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.maths.elementary import cast, expm1, log, sine_cosine
from nerfbake.scene.basis import SH_SIZES
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import BasisColour, HeadColour, Mlp, Network

_HEAD = 1 << 10  # bytes that contain the outer keys
_PLACE = "optimizer.target.params"
_KEYS = ("near", "far", "white_bkgd", "dataset", "spherify", "legacy_posenc_order", "sigma_activation", "min_deg_point")
_ALLOWED = "a checkpoint of JaxNeRF, NeRF-SH or NeRF-SG"
_CONES = "a mip-NeRF, whose samples are cones and not points"
_RELATIVES = {  # parts of the keys of other programs' networks
    "NerfMLP": _CONES,
    "PropMLP": _CONES,
    "warp": "a scene that changes with time",
    "time": "a scene that changes with time",
}
_MOST_LOBES = 256


def recognise(view: memoryview) -> bool:
    """Return True for MessagePack with the outer keys of a checkpoint of flax."""
    head = bytes(view[:_HEAD])
    if not 0x81 <= (head or b"\0")[0] <= 0x8F:
        return False
    return (b"\xa9optimizer" in head and b"\xa6target" in head) or (b"\xa6params" in head and b"\xa7Dense_0" in head)


def decode(view: memoryview, *, beside: Mapping[str, memoryview] | None = None) -> FunctionField:
    """Return the field of a checkpoint. beside: the files of its folder. Raises InvalidFile, MemoryLimit."""
    run = YamlBeside(beside or {}, _KEYS)
    if run.values.get("dataset") == "llff" and not run.flag("spherify", False):
        place = run.places["dataset"]
        raise InvalidFile(
            Problem(place, "describes a forward-facing scene (NDC)", "a scene with spherify, or of Blender")
        )
    if (kind := run.values.get("sigma_activation", "relu")) not in ("relu", "softplus"):
        raise run.refusal("sigma_activation", "relu or softplus")
    if run.values.get("min_deg_point", 0) != 0:
        raise run.refusal("min_deg_point", "0")
    near, far = run.number("near", 2.0), run.number("far", 6.0)
    if far <= near:
        raise run.refusal("far" if "far" in run.values else "near", f"near {near:g} below far {far:g}")
    checkpoint = _Checkpoint(view)
    order: Order = "by frequency" if run.flag("legacy_posenc_order", False) else "sines first"
    network, program = _network(checkpoint, order, Activation("softplus" if kind == "softplus" else "relu"))
    box = usual_box(near, far)
    white = run.flag("white_bkgd", False)
    notes = [CORNER_NOTE, box_note(box)]
    if not run.values:
        notes.insert(
            0, f"no YAML file of its run is beside it: depths of {near:g} to {far:g} are assumed, as of Blender"
        )
    return FunctionField(
        network=network,
        frame=np.eye(3, 4),
        box=box,
        background=((1.0,) * 3 if white else (0.0,) * 3) if "white_bkgd" in run.values else None,
        near=near,
        far=far,
        dialect=program,
        notes=tuple(notes),
    )


class _Checkpoint:
    """The layers of the fine network, or of the only one, in order, and the other parameters."""

    def __init__(self, view: memoryview) -> None:
        root = parse_map(view, "checkpoint", skip=("optimizer.state", "opt_state"))
        self.parameters: Any = root
        for key in ("optimizer", "target", "params"):
            inner = self.parameters.get(key)
            self.parameters = inner if isinstance(inner, dict) else self.parameters
        name = next((each for each in ("MLP_1", "MLP_0") if isinstance(self.parameters.get(each), dict)), None)
        if name is None:
            raise InvalidFile(Problem(_PLACE, _unknown(self.parameters), _ALLOWED))
        self.place, layers = f"{_PLACE}.{name}", self.parameters[name]
        self.layers = [self._layer(layers, each) for each in layer_names(_numbered(layers), "Dense")]
        if not self.layers:
            raise InvalidFile(Problem(self.place, "has no Dense_0", _ALLOWED))
        if name == "MLP_0" and self.layers[0].inputs % 6 == 0:  # sines and cosines without the position itself
            raise InvalidFile(Problem(self.place, f"is {_CONES}", _ALLOWED))

    def _layer(self, layers: dict[str, Any], name: str) -> Layer:
        name = name.replace(".", "_")
        place, layer = f"{self.place}.{name}", layers.get(name)
        if not isinstance(layer, dict):
            raise InvalidFile(Problem(self.place, f"has no {name}", "layers that are numbered without a gap"))
        return layer_of(place, self.single(layer, "kernel", place).T, self.single(layer, "bias", place))

    def single(self, table: dict[str, Any], key: str, place: str) -> Singles:
        """Return an array of floats as float32."""
        array = table.get(key)
        if not isinstance(array, np.ndarray):
            raise InvalidFile(Problem(f"{place}.{key}", "is not an array", "an array of floats"))
        found: npt.NDArray[Any] = array
        return as_singles(found, f"{place}.{key}")


def _numbered(layers: dict[str, Any]) -> list[str]:
    """Return the keys of layers as Dense.0 and so on: the map has them in alphabetical order."""
    return [key.replace("_", ".", 1) for key in layers if key.startswith("Dense_")]


def _unknown(parameters: dict[str, Any]) -> str:
    """Describe a checkpoint without a known network."""
    keys = [*parameters, *(key for part in parameters.values() if isinstance(part, dict) for key in part)]
    for part, what in _RELATIVES.items():
        if any(part in key for key in keys):
            return f"is {what}"
    return "has no MLP_1 and no MLP_0"


def _network(checkpoint: _Checkpoint, order: Order, activation: Activation) -> tuple[Network, str]:
    """Return the network, and the name of the program."""
    layers = checkpoint.layers
    count = next((k for k, layer in enumerate(layers) if layer.outputs == 1), None)
    if count is None or len(layers) - count not in (2, 4):
        found = f"has {len(layers)} layers" + ("" if count is None else f", the density in number {count}")
        raise InvalidFile(Problem(checkpoint.place, found, "1 or 3 layers of colours after the density"))
    trunk = trunk_of(layers[:count], order, code_first=False)
    density = layers[count]
    density.require_inputs(trunk.outputs)
    layers[count + 1].require_inputs(trunk.outputs)
    colour: HeadColour | BasisColour
    if len(layers) - count == 4:
        program, colour = "JaxNeRF", _by_direction(layers[count + 1 :], order)
    else:
        program, colour = _coefficients(checkpoint, layers[count + 1])
    encoding = octaves((trunk.inputs - 3) // 6, rounded=True)
    return Network(encoding, trunk, density.weight[0], float(density.bias[0]), activation, colour), program


def _by_direction(layers: list[Layer], order: Order) -> HeadColour:
    bottleneck, condition, last = layers
    last.require_inputs(condition.outputs)
    last.require_outputs(3)
    frequencies = frequencies_in(condition, bottleneck.outputs)
    own = after_features(condition, columns_of(order, frequencies), code_first=False)
    first, bias = folded(condition, own, bottleneck)
    code = octaves(frequencies, rounded=True)
    return HeadColour(Mlp((first, last.weight), (bias, last.bias)), code)


def _coefficients(checkpoint: _Checkpoint, last: Layer) -> tuple[str, HeadColour | BasisColour]:
    mlp, parameters = Mlp((last.weight,), (last.bias,)), checkpoint.parameters
    if "sg_lambda" in parameters:
        sharpness, angles = (checkpoint.single(parameters, key, _PLACE) for key in ("sg_lambda", "sg_mu_spher"))
        n = len(sharpness) if sharpness.ndim == 1 else 0
        if not 1 <= n <= _MOST_LOBES or angles.shape != (n, 2):
            found = f"has shape {sharpness.shape}, and sg_mu_spher {angles.shape}"
            raise InvalidFile(Problem(f"{_PLACE}.sg_lambda", found, f"(n,) and (n, 2), {_MOST_LOBES} lobes at most"))
        if not (np.abs(angles) < 1e6).all():
            raise InvalidFile(Problem(f"{_PLACE}.sg_mu_spher", "has angles that are not finite", "radians"))
        last.require_outputs(3 * n)
        return "NeRF-SG", BasisColour(mlp, _lobes(sharpness, angles))
    last.require_outputs(3, *(3 * size for size in SH_SIZES[1:]))
    if last.outputs == 3:
        return "JaxNeRF", HeadColour(mlp, "none")
    return "NeRF-SH", BasisColour(mlp)


def _lobes(raw: Singles, angles: Singles) -> Singles:
    """(n, 4) axes and sharpness, the softplus of the raw numbers."""
    (sine, cosine), (sine_z, cosine_z) = sine_cosine(angles[:, 1]), sine_cosine(angles[:, 0])
    wide = cast(raw, np.float64)
    sharpness = np.maximum(wide, 0) + log(2 + expm1(-np.abs(wide)))
    return cast(np.stack([sine_z * cosine, sine_z * sine, cosine_z, sharpness], axis=1), np.float32)
