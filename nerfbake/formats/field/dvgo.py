"""DirectVoxGO's checkpoint (fine_last.tar, coarse_last.tar), a file of torch's. Keys: docs/formats/checkpoints.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.dvgo_model import POSITIONS, Model, colour_of
from nerfbake.formats.field.factors import factors_of, rows_of, shape_of
from nerfbake.formats.field.torch_model import every_node
from nerfbake.formats.wire.torch_zip import is_torch
from nerfbake.kernels.arrays import Singles
from nerfbake.scene.lattice_field import LatticeField, MlpColour

_HEAD = 1 << 20  # bytes that the pickle is in, which stands first
Nodes = npt.NDArray[np.int32]


def recognise(view: memoryview) -> bool:
    """True for a file of torch's with the settings that this program keeps."""
    return is_torch(view) and b"model_kwargs" in bytes(view[:_HEAD])


def decode(view: memoryview) -> LatticeField:
    """The lattice of a checkpoint."""
    model = Model(view)
    if model.settings.get("density_type") == "VDBGrid" and "density.grid" not in model.state:
        found = "has density_type VDBGrid: of PlenVDB, whose grids are in files beside this one"
        raise InvalidFile(Problem("model_kwargs", found, "the folder with finedensity.vdb and finecolor.vdb"))
    density = _grid(model, "density", 1)
    shape = density.shape[1:]
    colour = colour_of(model)
    places = POSITIONS if isinstance(colour, MlpColour) and colour.encoded else 0
    links = every_node(shape)
    features = _features(model, links, colour.features - places)
    if places:
        features = _with_places(features, shape)
    return model.lattice(links, density.reshape(-1), features, colour, _dialect(model))


def _dialect(model: Model) -> str:
    if model.of_2021:
        return "DirectVoxGO, 2021"
    return "DirectVoxGO" if "density.grid" in model.state else "DirectVoxGO, early 2022"


def _features(model: Model, links: Nodes, channels: int) -> npt.NDArray[Any]:
    """(n, C) of every node, x-major; each channel lies together, where it does in the file."""
    if "k0.xy_plane" in model.state:
        return _of_planes(model, links, channels)
    features = _grid(model, "k0", channels)
    if features.shape[1:] != links.shape:
        raise InvalidFile(Problem("k0", f"has {features.shape[1:]} nodes", f"{links.shape}, as density has"))
    return features.reshape(channels, -1).T


def _of_planes(model: Model, links: Nodes, channels: int) -> Singles:
    """Of planes and vectors (its TensoRFGrid)."""
    planes: dict[str, Singles] = {}
    lines: dict[str, Singles] = {}
    for plane, line in (("xy_plane", "z_vec"), ("xz_plane", "y_vec"), ("yz_plane", "x_vec")):
        for name, found in ((f"k0.{plane}", planes), (f"k0.{line}", lines)):
            array = model.single(name)
            if array.ndim != 4 or array.shape[0] != 1 or 0 in array.shape:
                raise InvalidFile(Problem(name, f"has shape {array.shape}", "(1, parts, nodes, nodes or 1)"))
            found[name] = array[0].transpose(1, 2, 0)
    for name, array in lines.items():
        if array.shape[1] != 1:
            raise InvalidFile(Problem(name, f"has {array.shape[:2]} nodes", "of one axis"))
        lines[name] = array[:, 0]
    factors = factors_of(planes, lines, model.single("k0.f_vec"), "k0.f_vec")
    if shape_of(factors) != links.shape:
        raise InvalidFile(Problem("k0", f"has {shape_of(factors)} nodes", f"{links.shape}, as density has"))
    if factors.matrix.shape[1] != channels:
        raise InvalidFile(Problem("k0.f_vec", f"makes {factors.matrix.shape[1]} channels", f"{channels}"))
    return rows_of(links, links.size, factors, "k0")


def _with_places(features: npt.NDArray[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Three more features: where a node stands in the box, 0 to 1, which is exact between the nodes, too."""
    n, channels = features.shape
    memory.hold("k0", 4 * n * (channels + POSITIONS))
    rows = np.empty((channels + POSITIONS, n), np.float32)
    rows[:channels] = features.T
    for axis, edge in enumerate(shape):
        along = np.linspace(0, 1, edge, dtype=np.float32).reshape([-1 if i == axis else 1 for i in range(3)])
        rows[channels + axis] = np.broadcast_to(along, shape).reshape(-1)
    return rows.T


def _grid(model: Model, name: str, channels: int) -> Singles:
    """(C, X, Y, Z) of name.grid, or of name alone, as it was before April 2022."""
    key = name if name in model.state and f"{name}.grid" not in model.state else f"{name}.grid"
    array = model.single(key)
    if array.ndim != 5 or array.shape[0] != 1 or array.shape[1] != channels:
        allowed = f"(1, {channels}, X, Y, Z)"
        raise InvalidFile(Problem(key, f"has shape {array.shape}", allowed))
    found: Singles = array[0]
    return found
