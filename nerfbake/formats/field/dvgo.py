"""DirectVoxGO's checkpoint (fine_last.tar, coarse_last.tar), a file of torch's. Keys: docs/formats/checkpoints.md."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.dvgo_model import Model, colour_of
from nerfbake.formats.field.torch_model import every_node
from nerfbake.formats.wire.torch_zip import is_torch
from nerfbake.scene.lattice_field import LatticeField

_HEAD = 1 << 20  # bytes that the pickle is in, which stands first


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
    if "k0.xy_plane" in model.state:
        raise InvalidFile(Problem("k0", "is of planes and vectors (TensoRFGrid)", "a DenseGrid"))
    features = _grid(model, "k0", colour.features)
    if features.shape[1:] != shape:
        raise InvalidFile(Problem("k0", f"has {features.shape[1:]} nodes", f"{shape}, as density has"))
    dialect = "DirectVoxGO" if "density.grid" in model.state else "DirectVoxGO, early 2022"
    # Each channel lies together, as in the file.
    rows = features.reshape(colour.features, -1).T
    return model.lattice(every_node(shape), density.reshape(-1), rows, colour, dialect)


def _grid(model: Model, name: str, channels: int) -> npt.NDArray[np.float32]:
    """(C, X, Y, Z) of name.grid, or of name alone, as it was before April 2022."""
    key = name if name in model.state and f"{name}.grid" not in model.state else f"{name}.grid"
    array = model.single(key)
    if array.ndim != 5 or array.shape[0] != 1 or array.shape[1] != channels:
        allowed = f"(1, {channels}, X, Y, Z)"
        raise InvalidFile(Problem(key, f"has shape {array.shape}", allowed))
    found: npt.NDArray[np.float32] = array[0]
    return found
