"""Read checkpoints of torch-ngp, `checkpoints/ngp.pth` or `ngp_ep0100.pth`, which torch writes.

    model
      encoder.embeddings           (rows, F), level after level; encoder.offsets (L + 1,) is the first row of each level
      sigma_net.{0,1}.weight       (64, L F), (16, 64): output 0 is ln density
      color_net.{0,1,2}.weight     (64, 31), (64, 64), (3, 64): 16 spherical harmonics of the direction, 15 features
      aabb_train                   -bound three times, bound three times
      density_bitfield             uint8: bit i % 8 of byte i / 8 is cell i, see occupied_cells.py; cube c reaches from
                                   -min(2^c, bound) to min(2^c, bound)

Nothing has a bias. The levels are tiny-cuda-nn's, but for the dense ones: they have one more node along an axis than a
level's s = 2^(l log2 b) 16 - 1 asks for, and log2 b = log2(2048 bound / 16) / (L - 1) is rounded to float32 once. After
training with --tcnn, encoder.params, sigma_net.params and color_net.params are as tcnn.py describes them.

A camera at p of transforms.json is trained at 0.33 (y, z, x), unless another --scale or --offset was given, which no
file holds. Source: docs/fields.md, "Programs"; gridencoder.cu, nerf/network.py, nerf/provider.py.
"""

from __future__ import annotations

import math

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field import tcnn
from nerfbake.formats.field.occupied_cells import CELLS, EDGE, nested_cubes
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.formats.wire.torch import mentions
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.scene.function_field import MAX_CASCADES, FunctionField, Occupancy
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import HashGrid, HeadColour, Mlp, Network

_SCALE = 0.33
_BASE, _FINEST = 16, 2048
_CODE = 16
_MOST_BOUND = 128.0
_MOST_LAYERS, _MOST_LEVELS = 16, 64
_NEAR = 0.2  # min_near
_TCNN = tcnn.Grid(16, 2, 19, _BASE, np.float32(0))  # with --tcnn; its growth depends on the bound
_WIDTH = 64
_REFUSED = {
    "deform_net.0.weight": "is a scene that changes with time (D-NeRF)",
    "sigma_net.weights": "was trained with `--ff`, whose networks are flat arrays",
}


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with torch-ngp's encoder or its networks."""
    return mentions(view, b"encoder.", b"sigma_net", b"color_net")


def decode(view: memoryview) -> FunctionField:
    """Return the field of a checkpoint. Raises InvalidFile, MemoryLimit."""
    model = TorchModel(view, "model", "model", "torch-ngp")
    for key, what in _REFUSED.items():
        if key in model.state:
            raise InvalidFile(Problem("model", what, "a static scene that was trained without `--ff`"))
    bound = _bound(model)
    cube = bound * np.array([[-1.0] * 3, [1.0] * 3])
    notes = [f"the scale of the cameras is not in the file: torch-ngp's default {_SCALE} is assumed"]
    if any(key.startswith(("bg_net.", "encoder_bg.")) for key in model.state if isinstance(key, str)):
        notes.append("the background sphere is not read")
    if isinstance(model.file.root, dict) and "ema" in model.file.root:
        notes.append("the averaged parameters (ema) are not read; the best checkpoint, ngp.pth, consists of them")
    return FunctionField(
        network=_network(model, bound),
        frame=_SCALE * np.eye(3, 4)[[1, 2, 0]],
        box=cube,
        unit=cube,
        occupied=_occupancy(model, bound),
        background=(1.0, 1.0, 1.0),
        near=_NEAR,
        dialect="torch-ngp",
        notes=(*notes, *model.file.notes),
    )


def _bound(model: TorchModel) -> float:
    box = model.floats("aabb_train", (6,))
    bound = float(box[3])
    if not 0 < bound <= _MOST_BOUND or (box != bound * np.array([-1, -1, -1, 1, 1, 1])).any():
        found = f"is {', '.join(f'{each:g}' for each in box)}"
        raise InvalidFile(Problem("aabb_train", found, f"a cube around 0, of half an edge up to {_MOST_BOUND:g}"))
    return bound


def _network(model: TorchModel, bound: float) -> Network:
    if "encoder.params" in model.state:
        grid, trunk, head = _tcnn_parts(model, bound)
    else:
        grid, trunk, head = _grid(model, bound), _layers(model, "sigma_net"), _layers(model, "color_net")
    outputs = trunk.outputs
    if head.inputs != _CODE + outputs - 1:
        raise InvalidFile(Problem("color_net", f"takes {head.inputs} inputs", f"{_CODE + outputs - 1}"))
    first = head.weights[0]
    own = np.zeros((len(first), outputs + _CODE), np.float32)
    own[:, 1:outputs], own[:, outputs:] = first[:, _CODE:], first[:, :_CODE]
    density = np.zeros(outputs, np.float32)
    density[0] = 1
    colour = HeadColour(Mlp((own, *head.weights[1:]), head.biases), "SH16")
    return Network(grid, trunk, density, 0.0, Activation("exponential"), colour)


def _tcnn_parts(model: TorchModel, bound: float) -> tuple[HashGrid, Mlp, Mlp]:
    growth = exp(log(_FINEST * bound / _BASE) / (_TCNN.levels - 1))
    grid = _TCNN._replace(growth=np.float32(growth))
    names = "encoder.params", "sigma_net.params", "color_net.params"
    table, trunk, head = (model.single(name).reshape(-1) for name in names)
    first = tcnn.Perceptron(grid.inputs, _WIDTH, 1, 16, ones=True)
    second = tcnn.Perceptron(_CODE + 15, _WIDTH, 2, 3, ones=True)
    found = tcnn.hash_grid_of(table, grid, names[0])
    return found, tcnn.mlp_of(trunk, first, names[1]), tcnn.mlp_of(head, second, names[2])


def _layers(model: TorchModel, stem: str) -> Mlp:
    count = next(k for k in range(_MOST_LAYERS + 1) if f"{stem}.{k}.weight" not in model.state or k == _MOST_LAYERS)
    weights = tuple(model.single(f"{stem}.{k}.weight") for k in range(max(count, 1)))
    return Mlp(weights, tuple(np.zeros(len(each) if each.ndim else 0, np.float32) for each in weights))


def _grid(model: TorchModel, bound: float) -> HashGrid:
    table, first = model.single("encoder.embeddings"), _offsets(model)
    levels = len(first) - 1
    if table.ndim != 2 or len(table) != first[-1]:
        raise InvalidFile(
            Problem("encoder.embeddings", f"has shape {table.shape}", f"{first[-1]:,} rows, as offsets say")
        )
    scale = tcnn.scales_of(levels, _BASE, np.float32(math.log2(_FINEST * bound / _BASE) / max(levels - 1, 1)))
    nodes = np.ceil(scale).astype(np.int64) + 2
    fits = nodes.astype(np.float64) ** 3 <= np.diff(first)
    return HashGrid(table, first, scale, np.where(fits, nodes, 0), 0.5)


def _offsets(model: TorchModel) -> Ints:
    offsets = model.any("encoder.offsets")
    if offsets.ndim != 1 or offsets.dtype.kind not in "iu" or not 2 <= len(offsets) <= _MOST_LEVELS + 1:
        found = f"has dtype {offsets.dtype}, shape {offsets.shape}"
        raise InvalidFile(Problem("encoder.offsets", found, f"whole numbers, 2 to {_MOST_LEVELS + 1}"))
    first = offsets.astype(np.int64)
    if first[0] != 0 or (np.diff(first) < 1).any():
        raise InvalidFile(
            Problem("encoder.offsets", f"are {', '.join(map(str, first[:8]))}", "ascending numbers from 0")
        )
    return first


def _occupancy(model: TorchModel, bound: float) -> Occupancy | None:
    """Return the cells that were found occupied; None if the program did not look for them."""
    if "density_bitfield" not in model.state:
        return None
    stored = model.any("density_bitfield")
    cascades = 1 + max(math.ceil(math.log2(bound)), 0)
    if stored.dtype != np.uint8 or stored.shape != (cascades * CELLS // 8,) or cascades > MAX_CASCADES:
        found = f"has dtype {stored.dtype}, shape {stored.shape}"
        allowed = f"uint8 ({cascades * CELLS // 8:,},), for {cascades} cubes of {EDGE}^3"
        raise InvalidFile(Problem("density_bitfield", found, allowed))
    memory.hold("the occupancy", cascades * CELLS)
    flags = np.unpackbits(stored, bitorder="little").view(bool).reshape(cascades, CELLS)
    return nested_cubes(flags, 0.0, [min(float(1 << c), bound) for c in range(cascades)])
