"""nerfstudio's vanilla-nerf: the network of NeRF with other frequencies.

    field_fine.mlp_base.layers.{0..7}          the encoded position; layer 4 also takes it, before the features
    field_fine.field_output_density.net        density, before softplus
    field_fine.mlp_head.layers.{0,1}           [encoded direction, features], ReLU after both
    field_fine.field_heads.0.net               colour, before the sigmoid

Positions have 10 frequencies 2 pi 2^(8 k / 9), directions 4 of 2 pi 2^(4 k / 3): they are no powers of two.
field_coarse is a second network of this form, which only places samples.

Source: docs/fields.md, "Programs".
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.nerf_layers import (
    Layer,
    Order,
    after_features,
    box_note,
    columns_of,
    frequencies_in,
    layer_names,
    layer_of,
    trunk_of,
    usual_box,
)
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import power
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network

_FIELD = "field_fine"
VANILLA = f"{_FIELD}.mlp_base.layers.0.weight"  # in the state of this model only
_OTHERS = {  # models without a reader, by a key of their state
    "field.mlp_base.layers.0.weight": "is a mip-NeRF, whose samples are cones and not points",
    "temporal_distortion": "is a scene that changes with time",
}
_ORDER: Order = "input last"
_HIGHEST, _HIGHEST_OF_DIRECTIONS = 8.0, 4.0  # exponents of the largest frequencies


def refuse_relatives(model: TorchModel) -> None:
    """Raise InvalidFile for mip-NeRF, and for a vanilla-nerf with a time axis."""
    for start, what in _OTHERS.items():
        if any(key.startswith(start) for key in model.state):
            raise InvalidFile(Problem("pipeline", what, "a NeRF without a time axis, such as vanilla-nerf"))


def field_of_vanilla_nerf(
    model: TorchModel, frame: Floats, *, near: float = 2.0, far: float = 6.0, background: float = 1.0
) -> FunctionField:
    """Return the field of a model. frame: from the world to the trained coordinates. Raises InvalidFile.

    near, far: the run's collider_params, which are 2 and 6 by default. background: its grey value, white by default.
    """
    refuse_relatives(model)
    layers = [_layer(model, name) for name in layer_names(model.state, f"{_FIELD}.mlp_base.layers")]
    trunk = trunk_of(layers, _ORDER, code_first=True)
    density, last = (_layer(model, f"{_FIELD}.{name}.net") for name in ("field_output_density", "field_heads.0"))
    density.require_inputs(trunk.outputs)
    density.require_outputs(1)
    last.require_outputs(3)
    first, second = (_layer(model, f"{_FIELD}.mlp_head.layers.{k}") for k in range(2))
    second.require_inputs(first.outputs)
    last.require_inputs(second.outputs)
    frequencies = frequencies_in(first, trunk.outputs)
    own = after_features(first, columns_of(_ORDER, frequencies), code_first=True)
    colour = Mlp((own, second.weight, last.weight), (first.bias, second.bias, last.bias))
    box = usual_box(near, far)
    return FunctionField(
        network=Network(
            _encoding((trunk.inputs - 3) // 6, _HIGHEST),
            trunk,
            density.weight[0],
            float(density.bias[0]),
            Activation("softplus"),
            HeadColour(colour, _encoding(frequencies, _HIGHEST_OF_DIRECTIONS)),
        ),
        frame=frame,
        box=box,
        background=(background,) * 3,
        near=near,
        far=far,
        dialect="vanilla-nerf",
        notes=(*model.file.notes, box_note(box)),
    )


def _layer(model: TorchModel, name: str) -> Layer:
    return layer_of(name, model.single(f"{name}.weight"), model.single(f"{name}.bias"))


def _encoding(count: int, highest: float) -> Frequencies:
    """Return `count` frequencies from 1 to 2^highest, in the program's precision."""
    exponents = np.linspace(0.0, highest, count).astype(np.float32).astype(np.float64)
    frequencies = np.array([power(2.0, each) for each in exponents]).astype(np.float32)
    return Frequencies(frequencies.astype(np.float64), rounded=True, unit=2 * np.pi)
