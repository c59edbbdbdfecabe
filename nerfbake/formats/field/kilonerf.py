"""Read fine-tuned checkpoints of KiloNeRF: `checkpoint_NNNNNNN.pth`, which torch writes.

    model_state_dict                  n networks; weights (n, in, out), and as `bmm` they are (n, out, in)
        pts_linears.{0,1}             the encoded position in the cell, from -1 to 1; ReLU
        alpha_linear                  density, per world unit, before ReLU
        feature_linear                without ReLU
        direction_layer, rgb_linear   [features, encoded direction]; ReLU; colour, before the sigmoid

The files of the run beside it (its configurations are split over several YAML files) say where the networks are:

    *.yaml          fixed_resolution: X, Y, Z; network (x Y + y) Z + z has the cell x, y, z of the domain
                    global_domain_min, global_domain_max: the domain, in the world
    bbox.txt        of the capture: the domain, where the YAML files lack it
    occupancy.pth   bool (X', Y', Z'): the parts of the domain that are not empty

Source: docs/fields.md, "Programs".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.nerf_layers import CORNER_NOTE, MAX_FREQUENCIES, Order, columns_of, layer_names, octaves
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.formats.field.yaml_beside import YamlBeside
from nerfbake.formats.wire.torch import TorchReader, mentions
from nerfbake.kernels.arrays import Ints, Points, Singles
from nerfbake.scene.function_field import FunctionField, Occupancy
from nerfbake.scene.network import Frequencies
from nerfbake.scene.network_grid import MAX_NETWORKS, NetworkGrid, Perceptrons

_STATE = "model_state_dict"
_ORDER: Order = "by coordinate"
_RESOLUTION, _LOW, _HIGH = "fixed_resolution", "global_domain_min", "global_domain_max"
_WHITE, _GLOBAL = "blender_white_background", "use_global_coordinates"
_BOX_FILE, _CELLS_FILE = "bbox.txt", "occupancy.pth"
_INSET = 1e-3  # world units from the domain's faces, in which the program has no density
_MOST_TEXT = 4096  # bytes
_NO_CELLS = f"{_CELLS_FILE} is not beside it: what the networks have in empty cells was never trained, and may show"
_FINE_TUNED = "a fine-tuned checkpoint (checkpoint_NNNNNNN.pth)"


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with KiloNeRF's networks."""
    return mentions(view, _STATE.encode(), b"direction_layer") or _is_distilled(view)


def _is_distilled(view: memoryview) -> bool:
    return mentions(view, b"multi_modules\n")


def decode(view: memoryview, *, beside: Mapping[str, memoryview] | None = None) -> FunctionField:
    """Return the field of a checkpoint. beside: the files of its folder. Raises InvalidFile, MemoryLimit."""
    if _is_distilled(view):
        found = "contains objects of KiloNeRF's classes: it is a distilled checkpoint"
        raise InvalidFile(Problem("data.pkl", found, _FINE_TUNED))
    model = TorchModel(view, _STATE, _STATE, "KiloNeRF")
    files = beside or {}
    run = YamlBeside(files, (_RESOLUTION, _LOW, _HIGH, _WHITE, _GLOBAL, "near", "far"))
    if run.flag(_GLOBAL, False):
        raise run.refusal(_GLOBAL, "false: positions from -1 to 1 in each cell")
    stacked = _Stacked(model)
    cells = _cells(run, stacked.count)
    domain = _domain(run, files)
    occupied = _occupied(files[_CELLS_FILE], domain) if _CELLS_FILE in files else None
    notes = [*model.file.notes, CORNER_NOTE, *([] if occupied else [_NO_CELLS])]
    return FunctionField(
        network=stacked.grid(domain, cells),
        frame=np.eye(3, 4),
        box=domain + np.array([[_INSET], [-_INSET]]),
        occupied=occupied,
        background=(1.0,) * 3 if run.flag(_WHITE, True) else (0.0,) * 3,
        near=run.number("near", 0.0),
        far=run.number("far", 1e6),
        dialect="KiloNeRF",
        notes=tuple(notes),
    )


class _Stacked:
    """The layers of all networks, as (n, out, in). count: n."""

    def __init__(self, model: TorchModel) -> None:
        self._model = model
        names = layer_names(model.state, "pts_linears")
        if not names:
            raise InvalidFile(Problem(_STATE, "has no pts_linears.0", f"{_FINE_TUNED} of KiloNeRF"))
        first, bias = model.single(f"{names[0]}.weight"), model.single(f"{names[0]}.bias")
        if first.ndim != 3 or bias.ndim != 2 or bias.shape[1] not in first.shape[1:]:
            found = f"has weights of shape {first.shape} and biases of shape {bias.shape}"
            raise InvalidFile(Problem(names[0], found, "(n, in, out) and (n, out)"))
        self.count = len(first)
        if self.count > MAX_NETWORKS:
            raise InvalidFile(Problem(names[0], f"has {self.count:,} networks", f"{MAX_NETWORKS:,} at most"))
        self._turned = first.shape[2] == bias.shape[1]  # (n, in, out)
        self._trunk = [self._layer(name) for name in names]

    def _layer(self, name: str) -> tuple[Singles, Singles]:
        weight, bias = self._model.single(f"{name}.weight"), self._model.single(f"{name}.bias")
        own = weight.swapaxes(1, 2) if self._turned and weight.ndim == 3 else weight
        if own.ndim != 3 or bias.shape != own.shape[:2] or len(own) != self.count:
            found = f"has weights of shape {weight.shape} and biases of shape {bias.shape}"
            shape = "in, out" if self._turned else "out, in"
            raise InvalidFile(Problem(name, found, f"({self.count}, {shape}) and ({self.count}, out)"))
        memory.hold(name, 12 * own.size)  # copies in another order, and for kernels
        return own, bias

    def grid(self, domain: Points, cells: tuple[int, int, int]) -> NetworkGrid:
        """Return the networks, with the inputs of their layers in the common order."""
        (first, first_bias), *middle = self._trunk
        columns = _columns("pts_linears.0", first.shape[2])
        feature, alpha, direction, rgb = map(
            self._layer, ("feature_linear", "alpha_linear", "direction_layer", "rgb_linear")
        )
        if alpha[0].shape[1] != 1 or feature[0].shape[2] != alpha[0].shape[2]:
            found = (
                f"makes {alpha[0].shape[1]} numbers of {alpha[0].shape[2]}, feature_linear takes {feature[0].shape[2]}"
            )
            raise InvalidFile(Problem("alpha_linear", found, "one density, of the same inputs"))
        features = feature[0].shape[1]
        code = _columns("direction_layer", direction[0].shape[2] - features)
        own = [*range(features), *(features + code)]
        both = tuple(np.concatenate([a, b], axis=1) for a, b in zip(feature, alpha, strict=True))
        return NetworkGrid(
            domain=domain,
            cells=cells,
            encoding=_encoding(columns),
            trunk=Perceptrons(
                (first[:, :, columns], *(weight for weight, _ in middle), both[0]),
                (first_bias, *(bias for _, bias in middle), both[1]),
            ),
            code=_encoding(code),
            head=Perceptrons((direction[0][:, :, own], rgb[0]), (direction[1], rgb[1])),
        )


def _columns(name: str, inputs: int) -> Ints:
    """Return the place in the file of each input of the encoding."""
    count, rest = divmod(inputs - 3, 6)
    if rest or not 0 <= count <= MAX_FREQUENCIES:
        allowed = f"3, and 6 for each of up to {MAX_FREQUENCIES} frequencies"
        raise InvalidFile(Problem(name, f"takes {inputs} inputs for a position or direction", allowed))
    return columns_of(_ORDER, count)


def _encoding(columns: Ints) -> Frequencies:
    return octaves((len(columns) - 3) // 6)


# -- files beside it -------------------------------------------------------------------------------------------
def _cells(run: YamlBeside, count: int) -> tuple[int, int, int]:
    if _RESOLUTION not in run.values:
        found = f"have no {_RESOLUTION}, and say not where its {count:,} networks are"
        allowed = f"the run's YAML files with {_RESOLUTION}, {_LOW} and {_HIGH} (or {_BOX_FILE} with the domain)"
        raise InvalidFile(Problem("the files beside it", found, allowed))
    match run.values[_RESOLUTION]:
        case [int(x), int(y), int(z)] if min(x, y, z) >= 1 and x * y * z == count:
            return x, y, z
    raise run.refusal(_RESOLUTION, f"three numbers with the product {count:,}, the number of networks")


def _domain(run: YamlBeside, files: Mapping[str, memoryview]) -> Points:
    if _LOW in run.values and _HIGH in run.values:
        corners = []
        for key in (_LOW, _HIGH):
            found = run.values[key]
            if not isinstance(found, list) or len(found) != 3 or any(type(each) not in (int, float) for each in found):
                raise run.refusal(key, "three numbers")
            corners.append(found)
        return _box(corners, f"{run.places[_LOW]}: {_LOW}")
    if _BOX_FILE not in files:
        allowed = f"a YAML file with {_LOW} and {_HIGH}, or {_BOX_FILE} of the capture"
        raise InvalidFile(Problem("the files beside it", f"have no {_LOW} and {_HIGH}", allowed))
    words = bytes(files[_BOX_FILE][:_MOST_TEXT]).decode("utf-8", "replace").split()
    try:
        numbers = [float(word) for word in words[:6]]
    except ValueError:
        numbers = []
    if len(numbers) < 6:
        raise InvalidFile(Problem(_BOX_FILE, "has no six numbers", "the lowest and the highest corner"))
    return _box([numbers[:3], numbers[3:]], _BOX_FILE)


def _box(corners: Any, place: str) -> Points:
    box = np.array(corners, np.float64)
    if not (np.abs(box) < 1e6).all() or not (box[1] - box[0] > 3 * _INSET).all():
        found = f"is no box: {box.reshape(-1).tolist()}"
        raise InvalidFile(Problem(place, found, f"the lowest corner, then the highest, {3 * _INSET:g} apart or more"))
    return box


def _occupied(view: memoryview, domain: Points) -> Occupancy:
    reader = TorchReader(view)
    cells = reader.array(reader.root, _CELLS_FILE)
    if cells.ndim != 3 or cells.dtype.kind not in "bu":
        found = f"has shape {cells.shape}, dtype {cells.dtype}"
        raise InvalidFile(Problem(_CELLS_FILE, found, "bool (X, Y, Z)"))
    memory.hold(_CELLS_FILE, cells.size)
    return Occupancy((cells != 0)[None], domain[None])
