"""nerfacto, as nerfstudio's own implementation in torch writes it: a hash grid, and two networks.

    field.mlp_base.model.0.hash_table           (L 2^T, F)  level-major; every level is hashed
    field.mlp_base.model.1.layers.{0,1}         (64, L F), (16, 64): output 0 is the density
    field.mlp_head.layers.{0,1,2}               (64, 63): 16 of the direction, 15 features, 32 of the appearance
    field.embedding_appearance.embedding.weight (pictures, 32): their mean is used

Source: docs/fields.md, "nerfacto".
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import HashGrid, HeadColour, Mlp, Network

_CODE, _OUTPUTS = 16, 16


def field_of_nerfacto(model: TorchModel, frame: Floats, *, init_density: float = 0.01, base: int = 16) -> FunctionField:
    """Return the field of a model. frame: from the world to the trained coordinates."""
    grid = _grid(model, base)
    trunk = _mlp(model, "field.mlp_base.model.1.layers", 2)
    head = _mlp(model, "field.mlp_head.layers", 3)
    appearance = model.single("field.embedding_appearance.embedding.weight").astype(np.float64).mean(axis=0)
    first = head.weights[0]
    if trunk.outputs != _OUTPUTS or first.shape[1] != _CODE + _OUTPUTS - 1 + len(appearance):
        raise InvalidFile(Problem("field.mlp_head", f"takes {first.shape[1]} inputs", "16, 15, and the appearance's"))
    own = np.zeros((len(first), _OUTPUTS + _CODE), np.float32)
    own[:, 1:_OUTPUTS] = first[:, _CODE : _CODE + _OUTPUTS - 1]
    own[:, _OUTPUTS:] = first[:, :_CODE]
    bias = head.biases[0] + (first[:, _CODE + _OUTPUTS - 1 :].astype(np.float64) * appearance).sum(axis=1)
    colour = Mlp((own, *head.weights[1:]), (bias.astype(np.float32), *head.biases[1:]))
    density = np.zeros(_OUTPUTS, np.float32)
    density[0] = 1
    activation = Activation("exponential", 0.0, init_density)
    return FunctionField(
        network=Network(grid, trunk, density, 0.0, activation, HeadColour(colour, "shifted")),
        frame=frame,
        box=np.array([[-1.0] * 3, [1.0] * 3]),
        unit=np.array([[-2.0] * 3, [2.0] * 3]),
        contracted=True,
        background="last",
        near=0.05,
        far=1000.0,
        dialect="nerfacto",
        notes=tuple(model.file.notes),
    )


def _grid(model: TorchModel, base: int) -> HashGrid:
    table = model.single("field.mlp_base.model.0.hash_table")
    numbers = (
        int(model.any(f"field.{name}").reshape(-1)[0]) for name in ("num_levels", "log2_hashmap_size", "max_res")
    )
    levels, size, most = numbers
    if table.ndim != 2 or not 1 <= levels <= 64 or not 1 <= size < 40 or len(table) != levels << size:
        found = f"has shape {table.shape} for {levels} levels of 2^{size} rows"
        raise InvalidFile(Problem("field.mlp_base.model.0.hash_table", found, "as many rows"))
    growth = np.float32(exp((log(most) - log(base)) / max(levels - 1, 1)))
    # The programs raise to the power in float32: the last level of the default has 2,047 cells, not 2,048.
    scale = np.floor(np.float32(base) * np.power(growth, np.arange(levels, dtype=np.float32))).astype(np.float32)
    return HashGrid(table, np.arange(levels + 1, dtype=np.int64) << size, scale, np.zeros(levels, np.int64), 0.0)


def _mlp(model: TorchModel, stem: str, layers: int) -> Mlp:
    names = [f"{stem}.{k}" for k in range(layers)]
    weights, biases = model.layers(names, names)
    return Mlp(tuple(weights.values()), tuple(biases.values()))
