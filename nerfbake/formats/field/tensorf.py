"""Read TensoRF checkpoints (.th), which torch writes: the products of planes and lines are a lattice's values.

Only nodes that contribute according to the mask get a row, to limit the memory. Keys: docs/formats/checkpoints.md.
Source: TensoRF (Chen et al., 2022), 4, and the files that its program writes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.factors import Shape, factors_of, rows_of, shape_of
from nerfbake.formats.field.torch_model import TorchModel, as_singles, every_node, format_setting, layers_of
from nerfbake.formats.wire.torch import mentions
from nerfbake.kernels.arrays import Bits, Points, Singles
from nerfbake.kernels.lattice.planes import Factors, nodes_around, touched_cells
from nerfbake.kernels.maths.elementary import cast
from nerfbake.scene.lattice_field import MAX_EDGE, Activation, Colour, LatticeField, MlpColour, ShColour

_LAYERS = ("renderModule.mlp.0", "renderModule.mlp.2", "renderModule.mlp.4")
_SH_FEATURES = 27
_MOST_FREQUENCIES = 16
_NODE_BYTES = 6  # bytes per node during the search for contributing nodes
# Keys of other TensoRF models, with a description for the error message.
_REFUSED = {"plane_coef": "the oldest model (TensorVM)", "density_line.0": "lines alone (TensorCP)"}
_COLOURS = "MLP_Fea, MLP or SH"


class _Mask(NamedTuple):
    cells: Bits
    box: Points


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with TensoRF's lines."""
    return mentions(view, b"density_line", b"basis_mat")


def decode(view: memoryview) -> LatticeField:
    """Return the lattice of a checkpoint. Raises InvalidFile, MemoryLimit."""
    model = TorchModel(view, "kwargs", "state_dict", "TensoRF")
    box = _box(model.settings.get("aabb"), model, "aabb")
    _require_world(model.settings, box)
    density = _factors(model, "density", None)
    basis = model.single("basis_mat.weight")
    if basis.ndim != 2:
        raise InvalidFile(Problem("basis_mat.weight", f"has shape {basis.shape}", "(features, parts)"))
    looks = _factors(model, "app", np.ascontiguousarray(basis.T))
    shape = shape_of(density)
    if shape_of(looks) != shape:
        raise InvalidFile(Problem("app_plane.0", f"has {shape_of(looks)} nodes", f"{shape}, as density_plane.0 has"))
    colour = _colour(model, len(basis))
    mask = _mask(model)
    links, n = _links(mask, box, shape)
    return LatticeField(
        links=links,
        density=rows_of(links, n, density, "density").reshape(-1),
        features=rows_of(links, n, looks, "colours"),
        activation=_activation(model),
        colour=colour,
        box=box,
        at_corners=True,
        occupied=mask.cells if mask else None,
        mask_box=mask.box if mask else None,
        dialect="TensoRF",
        notes=tuple(model.file.notes),
    )


def _require_world(settings: dict[Any, Any], box: Points) -> None:
    """Raise InvalidFile for a forward-facing scene: its near_far is 0 and 1, or its box is -1 to 1 along z."""
    reach = settings.get("near_far")
    if reach in ([0.0, 1.0], (0.0, 1.0)) or (reach is None and (box[:, 2] == (-1, 1)).all()):
        found = "is 0 to 1: a forward-facing scene (NDC), whose lattice is not a box in world space"
        raise InvalidFile(Problem("near_far", found, "a bounded scene of TensoRF"))


def _box(value: Any, model: TorchModel, name: str) -> Points:
    """Return the lowest and the highest corner, (2, 3)."""
    box = as_singles(model.file.array(value, name), name)
    if box.shape != (2, 3):
        raise InvalidFile(Problem(name, f"has shape {box.shape}", "(2, 3)"))
    return cast(box, np.float64)


def _factors(model: TorchModel, what: str, matrix: Singles | None) -> Factors:
    """Read density_plane and density_line, or app_plane and app_line.

    matrix: None for the density, which is the sum of all parts.
    """
    for key, kind in _REFUSED.items():
        if key in model.state and "density_plane.0" not in model.state:
            raise InvalidFile(Problem("state_dict", f"has {key}: {kind}", "planes and lines (TensorVMSplit)"))
    planes, lines = {}, {}
    for i in range(3):
        plane, line = (model.single(f"{what}_{each}.{i}") for each in ("plane", "line"))
        for name, array in ((f"{what}_plane.{i}", plane), (f"{what}_line.{i}", line)):
            if array.ndim != 4 or array.shape[0] != 1 or 0 in array.shape:
                raise InvalidFile(Problem(name, f"has shape {array.shape}", "(1, parts, nodes, nodes)"))
        if line.shape[3] != 1:
            raise InvalidFile(Problem(f"{what}_line.{i}", f"has shape {line.shape}", "(1, parts, nodes, 1)"))
        planes[f"{what}_plane.{i}"] = plane[0].transpose(2, 1, 0)
        lines[f"{what}_line.{i}"] = line[0, :, :, 0].T
    if matrix is None:
        matrix = np.ones((sum(each.shape[2] for each in planes.values()), 1), np.float32)
    return factors_of(planes, lines, matrix, "basis_mat.weight")


def _activation(model: TorchModel) -> Activation:
    kind = model.settings.get("fea2denseAct", "softplus")
    shift, scale = (_number(model, key) for key in ("density_shift", "distance_scale"))
    if kind == "softplus":
        return Activation("softplus", shift, scale)
    if kind == "relu":  # TensoRF ignores the shift for relu
        return Activation("relu", 0.0, scale)
    raise InvalidFile(Problem("fea2denseAct", f"is {format_setting(kind)}", "softplus or relu"))


def _number(model: TorchModel, key: str) -> float:
    found = model.file.array(model.settings.get(key), key)
    if found.size != 1 or found.dtype.kind not in "fiu":
        raise InvalidFile(Problem(key, f"has dtype {found.dtype}, shape {found.shape}", "one number"))
    return float(found.reshape(-1)[0])


def _colour(model: TorchModel, features: int) -> Colour:
    """Return the colour model for this number of features."""
    mode = model.settings.get("shadingMode")
    if mode == "SH":
        if features != _SH_FEATURES:
            raise InvalidFile(Problem("basis_mat.weight", f"has {features} rows", f"{_SH_FEATURES}, for SH"))
        return ShColour(_SH_FEATURES // 3)
    if mode not in ("MLP_Fea", "MLP"):
        kinds = {"MLP_PE": ", whose MLP takes positions as inputs", "RGB": ", colours without a bound"}
        kind = kinds.get(mode, "") if isinstance(mode, str) else ""
        raise InvalidFile(Problem("shadingMode", f"is {format_setting(mode)}{kind}", _COLOURS))
    views = _frequencies(model, "view_pe")
    sines = _frequencies(model, "fea_pe") if mode == "MLP_Fea" else ()
    layers = layers_of(*model.layers(list(_LAYERS), list(_LAYERS)))
    first, encoded = layers.first, 2 * features * len(sines)
    if first.shape[1] != features + 3 + encoded + 6 * len(views):
        found = f"takes {first.shape[1]} inputs"
        raise InvalidFile(
            Problem(_LAYERS[0], found, f"{features + 3 + encoded + 6 * len(views)}, for {features} features")
        )
    # Inputs in the file: features, d, sines of features, sines of d. In MlpColour each sine follows its values.
    parts = np.split(first, [features, features + 3, features + 3 + encoded], axis=1)
    layers = layers._replace(first=np.concatenate([parts[0], parts[2], parts[1], parts[3]], axis=1))
    return MlpColour(*layers, frequencies=views, encoded=features if sines else 0, feature_frequencies=sines)


def _frequencies(model: TorchModel, key: str) -> tuple[float, ...]:
    """Return the frequencies 1, 2, 4, ...; the setting is their number."""
    count = model.settings.get(key)
    if type(count) is not int or not 0 <= count <= _MOST_FREQUENCIES:
        raise InvalidFile(Problem(key, f"is {format_setting(count)}", f"0 to {_MOST_FREQUENCIES}"))
    return tuple(float(1 << i) for i in range(count))


def _mask(model: TorchModel) -> _Mask | None:
    """Return the cells in which samples count: those with a True node at a corner.

    This includes the cells outside the outermost nodes.
    """
    root = model.file.root
    if "alphaMask.aabb" not in root:
        return None
    shape = root.get("alphaMask.shape")
    sizes = shape if isinstance(shape, tuple) and all(type(edge) is int for edge in shape) else ()
    if (
        not 3 <= len(sizes) <= 5
        or any(edge != 1 for edge in sizes[:-3])
        or not all(2 <= e <= MAX_EDGE for e in sizes[-3:])
    ):
        raise InvalidFile(
            Problem("alphaMask.shape", f"is {sizes or format_setting(shape)}", f"(Z, Y, X), 2 to {MAX_EDGE} each")
        )
    Z, Y, X = sizes[-3:]
    packed = model.file.array(root.get("alphaMask.mask"), "alphaMask.mask")
    if packed.dtype != np.uint8 or packed.shape != ((X * Y * Z + 7) // 8,):
        found = f"has dtype {packed.dtype}, shape {packed.shape}"
        raise InvalidFile(Problem("alphaMask.mask", found, f"uint8 ({(X * Y * Z + 7) // 8},), bits of {sizes[-3:]}"))
    memory.hold("alphaMask.mask", 4 * (X + 2) * (Y + 2) * (Z + 2))
    nodes = np.unpackbits(packed, count=X * Y * Z).reshape(Z, Y, X).transpose(2, 1, 0).view(bool)
    box = _box(root.get("alphaMask.aabb"), model, "alphaMask.aabb")
    apart = (box[1] - box[0]) / (X - 1, Y - 1, Z - 1)
    return _Mask(touched_cells(nodes), np.stack([box[0] - apart, box[1] + apart]))


def _links(mask: _Mask | None, box: Points, shape: Shape) -> tuple[npt.NDArray[np.int32], int]:
    """Return links (X, Y, Z) from each contributing node to its row, x-major, and the number of rows."""
    edges = [box[1] - box[0]] + ([mask.box[1] - mask.box[0]] if mask else [])
    if not all(np.isfinite(each).all() and (each > 0).all() for each in edges):
        raise InvalidFile(Problem("aabb", "is not a box", "the lowest corner, then the highest, in finite numbers"))
    if mask is None:
        return every_node(shape), shape[0] * shape[1] * shape[2]
    size = max(shape[0] * shape[1] * shape[2], mask.cells.size)
    memory.require("the mask's nodes", _NODE_BYTES * size)
    contributing = nodes_around(mask.cells, box, mask.box, shape, at_corners=True)
    n = int(np.count_nonzero(contributing))
    memory.hold("links", 4 * contributing.size)
    links = np.full(shape, -1, np.int32)
    links[contributing] = np.arange(n, dtype=np.int32)
    return links, n
