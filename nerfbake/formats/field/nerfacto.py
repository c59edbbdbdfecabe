"""nerfacto and nerfstudio's instant-ngp: a hash grid, a network of the density, and a network of the colours.

| | `implementation: torch` | `implementation: tcnn` |
|---|---|---|
| 1.x | mlp_base.model.0.hash_table, mlp_base.model.1.layers.{0,1} | mlp_base.model.params: network, then grid |
| 0.2 to 0.3 | mlp_base.0.hash_table, mlp_base.1.layers.{0,1} | mlp_base.0 and mlp_base.1, .tcnn_encoding.params |
| 0.1 | | mlp_base.params: network, then grid |
| colours | mlp_head.layers.{0,1,2} | mlp_head.tcnn_encoding.params, in 0.1 mlp_head.params |

All keys start with `field.`. torch's table (L 2^T, F) is level-major and every level is hashed; its layers have biases;
its code of the direction are polynomials at (d + 1)/2. tcnn.py describes the other layout, with spherical harmonics.
Output 0 of the first network is the density. The second one takes 16 inputs of the direction, 15 features and the
appearance, whose mean over the pictures is used (nerfacto) or zeros (instant-ngp). Source: docs/fields.md, "Programs".
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field import tcnn
from nerfbake.formats.field.run_files import Run
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.formats.wire.torch_values import Tensor
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.scene.function_field import FunctionField, Occupancy
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import HashGrid, HeadColour, Mlp, Network

CODE, OUTPUTS = 16, 16  # inputs of the direction; outputs of the first network
_HIDDEN, _HEAD_HIDDEN = 1, 2  # hidden layers, which no setting changes
_MOST_LAYERS = 32
_APPEARANCE = "field.embedding_appearance.embedding.weight"
_GRIDS = ("occupancy_grid", "sampler.occupancy_grid")
_BINARIES = "binaries"


class _Layout(NamedTuple):
    """The keys of one generation, after `field.`. Without `grid` it is in the same array as the network."""

    network: str
    grid: str | None
    since: int  # the major version


# Where the same arrays have two names, in 0.2 and 0.3, the first one is taken.
_TORCH = (
    _Layout("mlp_base.model.1.layers", "mlp_base.model.0.hash_table", 1),
    _Layout("mlp_base_mlp.layers", "mlp_base_grid.hash_table", 0),
    _Layout("mlp_base.1.layers", "mlp_base.0.hash_table", 0),
)
_TCNN = (
    _Layout("mlp_base.model.params", None, 1),
    _Layout("mlp_base_mlp.tcnn_encoding.params", "mlp_base_grid.tcnn_encoding.params", 0),
    _Layout("mlp_base.1.tcnn_encoding.params", "mlp_base.0.tcnn_encoding.params", 0),
    _Layout("mlp_base.params", None, 0),
)
_HEADS = ("mlp_head.tcnn_encoding.params", "mlp_head.params")


class _Parts(NamedTuple):
    """The networks as the program has them. head: takes the direction's code, 15 features, and the appearance."""

    grid: HashGrid
    trunk: Mlp
    head: Mlp
    code: Any
    since: int


def is_nerfacto(model: TorchModel) -> bool:
    """Return whether the model has one of the layouts."""
    return any(f"field.{each.grid or each.network}" in model.state for each in _TORCH + _TCNN)


def is_instant_ngp(model: TorchModel) -> bool:
    """Return whether the model has nerfacto's field and an occupancy grid."""
    return is_nerfacto(model) and any(f"{grid}.{_BINARIES}" in model.state for grid in _GRIDS)


def field_of_nerfacto(model: TorchModel, run: Run) -> FunctionField:
    """Return the field of a model. Raises InvalidFile, MemoryLimit."""
    if any(key.startswith(grid) for key in model.state for grid in _GRIDS):
        found = "is an instant-ngp of nerfstudio before 0.3, which contracts space with another norm"
        raise InvalidFile(Problem("pipeline", found, f"one with {_GRIDS[0]}.{_BINARIES}"))
    appearance = mean_appearance(model, _APPEARANCE)
    if not run.flag("use_average_appearance_embedding", True):
        appearance = np.zeros_like(appearance)
    parts = _parts(model, run, len(appearance))
    usual = 0.01 if parts.since else 1.0
    density = run.number("average_init_density", usual, absent=1.0, low=1e-9, high=1e9)
    return _field(model, run, _network(parts, appearance, density), "nerfacto", "last_sample")


def field_of_instant_ngp(model: TorchModel, run: Run) -> FunctionField:
    """Return the field of a model, with its occupancy grid. Raises InvalidFile, MemoryLimit."""
    appearance = mean_appearance(model, _APPEARANCE)
    network = _network(_parts(model, run, len(appearance)), np.zeros_like(appearance), 1.0)
    found = _field(model, run, network, "nerfstudio's instant-ngp", "random")
    least = run.number("alpha_thre", 0.01, absent=0.0, low=0.0, high=1.0)
    notes = found.notes
    if least:
        notes += (f"samples of less than {least:g} opacity, which the program does not draw, are kept",)
    return replace(found, occupied=_occupancy(model), notes=notes)


def _field(model: TorchModel, run: Run, network: Network, dialect: str, background: str) -> FunctionField:
    aabb = model.floats("field.aabb", (2, 3))
    contracted = not run.flag("disable_scene_contraction", False)
    cube = np.array([[-1.0] * 3, [1.0] * 3])
    return FunctionField(
        network=network,
        frame=run.frame,
        box=cube if contracted else aabb,
        unit=2 * cube if contracted else aabb,
        contracted=contracted,
        cameras=run.cameras,
        background=run.background(background),
        near=run.number("near_plane", 0.05, low=0.0, high=1e9),
        far=run.number("far_plane", 1000.0, low=0.0, high=1e9),
        dialect=dialect,
        notes=(*run.notes, *model.file.notes),
    )


def _network(parts: _Parts, appearance: Singles, density: float) -> Network:
    """Put the inputs of the colours into the order of HeadColour. appearance: its part becomes a bias."""
    head, features = parts.head, OUTPUTS - 1
    first = head.weights[0]
    if parts.trunk.outputs != OUTPUTS or head.inputs != CODE + features + len(appearance) or head.outputs != 3:
        found = f"is {head}, after {parts.trunk}"
        raise InvalidFile(
            Problem("field.mlp_head", found, f"{CODE} + {features} + {len(appearance)} inputs, for 3 outputs")
        )
    own = np.zeros((len(first), OUTPUTS + CODE), np.float32)
    own[:, 1:OUTPUTS] = first[:, CODE : CODE + features]
    own[:, OUTPUTS:] = first[:, :CODE]
    bias = tcnn.bias_with(head.biases[0], first[:, CODE + features :], appearance)
    colour = HeadColour(Mlp((own, *head.weights[1:]), (bias, *head.biases[1:])), parts.code)
    weights = np.zeros(OUTPUTS, np.float32)
    weights[0] = 1
    return Network(parts.grid, parts.trunk, weights, 0.0, Activation("exponential", 0.0, density), colour)


def mean_appearance(model: TorchModel, key: str) -> Singles:
    """(A,) the mean of the pictures' appearances; empty without any. Raises InvalidFile, MemoryLimit."""
    stored = model.state.get(key)
    if stored is None or (isinstance(stored, Tensor) and 0 in stored.size):
        return np.zeros(0, np.float32)
    table = model.single(key)
    if table.ndim != 2:
        raise InvalidFile(Problem(key, f"has shape {table.shape}", "(pictures, numbers)"))
    memory.require(key, 8 * table.size)
    with np.errstate(invalid="ignore", over="ignore"):  # problems() reports numbers that are not finite
        return np.asarray(table.astype(np.float64).mean(axis=0), np.float32)


def _parts(model: TorchModel, run: Run, appearance: int) -> _Parts:
    for layout in _TORCH:
        if f"field.{layout.grid}" in model.state:
            return _torch_parts(model, run, layout)
    layout = next(each for each in _TCNN if f"field.{each.grid or each.network}" in model.state)
    return _tcnn_parts(model, run, layout, appearance)


# -- the layout of torch ---------------------------------------------------------------------------------------
def _torch_parts(model: TorchModel, run: Run, layout: _Layout) -> _Parts:
    name = f"field.{layout.grid}"
    table = model.single(name)
    levels, size, most = _sizes(model, run)
    if table.ndim != 2 or len(table) != levels << size:
        found = f"has shape {table.shape}"
        raise InvalidFile(Problem(name, found, f"{levels << size:,} rows, for {levels} levels of 2^{size}"))
    base = run.whole("base_res", 16, low=1, high=most)
    # The program raises to the power in float32: the last level of the default has 2,047 cells, not 2,048.
    powers = exp(np.arange(levels) * log(np.float32(_growth(levels, base, most)))).astype(np.float32)
    scale = np.floor(np.float32(base) * powers)
    first = np.arange(levels + 1, dtype=np.int64) << size
    grid = HashGrid(table, first, scale, np.zeros(levels, np.int64), 0.0)
    return _Parts(
        grid,
        _layers(model, f"field.{layout.network}"),
        _layers(model, "field.mlp_head.layers"),
        "shifted",
        layout.since,
    )


def _layers(model: TorchModel, stem: str) -> Mlp:
    count = next(k for k in range(_MOST_LAYERS + 1) if f"{stem}.{k}.weight" not in model.state)
    names = [f"{stem}.{k}" for k in range(max(count, 1))]
    weights, biases = model.layers(names, names)
    return Mlp(tuple(weights.values()), tuple(biases.values()))


# -- the layout of tiny-cuda-nn --------------------------------------------------------------------------------
def _tcnn_parts(model: TorchModel, run: Run, layout: _Layout, appearance: int) -> _Parts:
    levels, size, most = _sizes(model, run)
    base = run.whole("base_res", 16, low=1, high=most)
    sizes = tcnn.Grid(levels, tcnn.FEATURES[0], size, base, np.float32(_growth(levels, base, most)))
    name = f"field.{layout.network}"
    tcnn.require_grid(sizes, name)
    params, rows = model.single(name).reshape(-1), tcnn.rows_of(sizes)
    for features in tcnn.FEATURES:
        sizes = sizes._replace(features=features)
        stored = model.single(f"field.{layout.grid}").reshape(-1) if layout.grid else params[-rows * features :]
        if (numbers := len(params) - (0 if layout.grid else rows * features)) <= 0 or len(stored) != rows * features:
            continue
        width = _width(numbers, sizes.inputs)
        if width:
            break
    else:
        found = f"has {len(params):,} numbers"
        allowed = f"a network and a hash grid of {rows:,} rows, for {levels} levels, 2^{size} rows, {most:,} nodes"
        raise InvalidFile(Problem(name, found, allowed))
    network = tcnn.Perceptron(sizes.inputs, width, _HIDDEN, OUTPUTS, ones=layout.grid is not None)
    trunk = tcnn.mlp_of(params[:numbers], network, name)
    grid = tcnn.hash_grid_of(stored, sizes, f"field.{layout.grid or layout.network}")
    return _Parts(grid, trunk, _tcnn_head(model, appearance), "SH16", layout.since)


def _width(numbers: int, inputs: int) -> int:
    """Return the width of the first network; 0 if none has as many numbers."""
    width, rest = divmod(numbers, tcnn.padded(inputs) + OUTPUTS)
    return width if not rest and width % tcnn.ALIGNED == 0 and width <= 1024 else 0


def _tcnn_head(model: TorchModel, appearance: int) -> Mlp:
    key = next((each for each in _HEADS if f"field.{each}" in model.state), _HEADS[0])
    name, inputs = f"field.{key}", CODE + OUTPUTS - 1 + appearance
    params = model.single(name).reshape(-1)
    width = tcnn.width_for(len(params), inputs=inputs, hidden=_HEAD_HIDDEN, outputs=3, name=name)
    return tcnn.mlp_of(params, tcnn.Perceptron(inputs, width, _HEAD_HIDDEN, 3, ones=True), name)


# -- sizes, occupancy ------------------------------------------------------------------------------------------
def _sizes(model: TorchModel, run: Run) -> tuple[int, int, int]:
    """Return the number of levels, the binary logarithm of their rows, and the nodes of the last level."""
    found = []
    for key, usual, low, high in (
        ("num_levels", 16, 1, 64),
        ("log2_hashmap_size", 19, 1, tcnn.MAX_LOG2_ROWS),
        ("max_res", 2048, 1, 1 << 24),
    ):
        name = f"field.{key}"
        if name not in model.state:
            found.append(run.whole(key, usual, low=low, high=high))
            continue
        array = model.any(name)
        value = int(array.reshape(-1)[0]) if array.size == 1 and array.dtype.kind in "iu" else -1
        if not low <= value <= high:
            given = f"is {value:,}" if value >= 0 else f"has dtype {array.dtype}, shape {array.shape}"
            raise InvalidFile(Problem(name, given, f"a whole number from {low:,} to {high:,}"))
        found.append(value)
    levels, size, most = found
    return levels, size, most


def _growth(levels: int, base: int, most: int) -> float:
    return float(exp((log(most) - log(base)) / max(levels - 1, 1)))


def _occupancy(model: TorchModel) -> Occupancy:
    grid = next(grid for grid in _GRIDS if f"{grid}.{_BINARIES}" in model.state)
    cells = model.any(f"{grid}.{_BINARIES}")
    boxes = model.single(f"{grid}.aabbs")
    if cells.dtype != np.bool_ or cells.ndim != 4 or boxes.shape != (len(cells), 6):
        found = f"has shape {cells.shape}, dtype {cells.dtype}, for boxes of shape {boxes.shape}"
        raise InvalidFile(Problem(f"{grid}.{_BINARIES}", found, "(levels, X, Y, Z) bool, and (levels, 6)"))
    return Occupancy(cells, boxes.astype(np.float64).reshape(-1, 2, 3))
