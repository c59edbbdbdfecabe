"""Read DirectVoxGO checkpoints (fine_last.tar, coarse_last.tar), which torch writes.

PlenVDB uses the same checkpoint, but stores the grids in separate files. The optimiser's state, which contains two more
grids for each grid, is never read. Keys: docs/formats/checkpoints.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.factors import factors_of, rows_of, shape_of
from nerfbake.formats.field.torch_model import TorchModel, every_node, layers_of
from nerfbake.formats.wire.torch import mentions
from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.maths.elementary import log, power
from nerfbake.scene.lattice_field import Activation, Colour, LatticeField, MlpColour, RgbColour

_LEAST = 1e-4  # opacity of a step below which DirectVoxGO's renderer skips a sample
# Keys of lattices that are not a box in world space, with a description for the error message.
_REFUSED = {
    "mpi_depth": "a forward-facing scene (NDC), whose lattice is not a box in world space",
    "scene_center": "an unbounded scene, whose lattice is contracted",
}
_FLAGS = {  # settings of DirectVoxGO before February 2022
    "nearest": "values of the nearest node, without interpolation",
    "pre_act_density": "opacities at the nodes, not densities",
    "in_act_density": "densities that are activated at the nodes",
}
_NO_MASK = "the mask from the coarse lattice is ignored; the nodes that it excludes are empty anyway"
POSITIONS = 3  # features that the file does not contain: the position of a node in the box


class DvgoModel(TorchModel):
    """A checkpoint: its settings, and the arrays of the model's state by key."""

    def __init__(self, view: memoryview) -> None:
        super().__init__(view, "model_kwargs", "model_state_dict", "DirectVoxGO")
        for key, what in _REFUSED.items():
            if key in self.settings:
                raise InvalidFile(Problem("model_kwargs", f"has {key}: {what}", "a bounded scene of DirectVoxGO"))
        if "act_shift.grid" in self.state:
            found = "has act_shift.grid: a forward-facing scene (NDC), whose lattice is not a box in world space"
            raise InvalidFile(Problem("model_state_dict", found, "a bounded scene of DirectVoxGO"))
        for key, what in _FLAGS.items():
            if self.settings.get(key, False) is not False:
                raise InvalidFile(Problem("model_kwargs", f"has {key}: {what}", "False, the default of DirectVoxGO"))

    @property
    def of_2021(self) -> bool:
        """True for files from before February 2022: the MLP takes positions, and no opacity is too small to count."""
        return "posbase_pe" in self.settings

    def lattice(
        self, links: npt.NDArray[np.int32], density: Singles, features: npt.NDArray[Any], colour: Colour, dialect: str
    ) -> LatticeField:
        """Return the lattice of these nodes. links, density (n,) and features (n, C) are as in scene.lattice_field."""
        low, high = self.floats("xyz_min", (3,)), self.floats("xyz_max", (3,))
        return LatticeField(
            links=links,
            density=density,
            features=features,
            activation=Activation("softplus", self._shift(), 1 / self._voxel_size(low, high)),
            colour=colour,
            box=np.stack([low, high]),
            at_corners=True,
            occupied=self.mask(),
            least=0.0 if self.of_2021 else _threshold(self.settings),
            dialect=dialect,
            notes=(*self.file.notes, *((_NO_MASK,) if "mask_cache.density" in self.state else ())),
        )

    def mask(self) -> Bits | None:
        """Return the nodes whose nearest samples count, (X, Y, Z) bool, or None if the model has no mask."""
        if "mask_cache.mask" not in self.state:
            return None
        mask = self.any("mask_cache.mask")
        if mask.dtype != np.bool_ or mask.ndim != 3:
            found = f"has dtype {mask.dtype}, shape {mask.shape}"
            raise InvalidFile(Problem("mask_cache.mask", found, "bool (X, Y, Z)"))
        return mask

    def _shift(self) -> float:
        """Return the trained shift, or compute it from alpha_init for older files that do not store it."""
        if "act_shift" in self.state:
            return float(self.floats("act_shift", (1,))[0])
        alpha = self.settings.get("alpha_init")
        if type(alpha) is not float or not 0 < alpha < 1:
            raise InvalidFile(
                Problem("model_kwargs", "has no alpha_init, and the model has no act_shift", "one of them")
            )
        return float(log(1 / (1 - alpha) - 1))

    def _voxel_size(self, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64]) -> float:
        """Return the voxel edge that opacities refer to, in world units."""
        base = self.file.array(self.settings.get("num_voxels_base"), "num_voxels_base")
        if base.size != 1:
            raise InvalidFile(Problem("num_voxels_base", f"has shape {base.shape}", "one number"))
        count = float(base.reshape(-1)[0])
        for name, corner in (("xyz_min", low), ("xyz_max", high)):
            if not np.isfinite(corner).all():
                raise InvalidFile(Problem(name, f"is {corner}", "three finite numbers"))
        volume = float(np.prod(high - low))
        if not 1 <= count < 1 << 48 or not 0 < volume < np.inf:
            found = f"is {count:g}, over a volume of {volume:g}"
            raise InvalidFile(Problem("num_voxels_base", found, "1 or more, over a box of positive volume"))
        return float(power(volume / count, 1 / 3))


def _threshold(settings: dict[Any, Any]) -> float:
    """Return the opacity of a step below which samples are skipped.

    A dict lists thresholds by training step; the last one is used.
    """
    value = settings.get("fast_color_thres", _LEAST)
    if isinstance(value, dict) and value:
        value = value[max(value, key=lambda key: key if isinstance(key, int) else -1)]
    if type(value) not in (int, float) or not 0 <= value < 1:
        raise InvalidFile(Problem("fast_color_thres", "is not an opacity", "0 or more, below 1"))
    return float(value)


def colour_of(model: DvgoModel) -> Colour:
    """Return the MLP, or RgbColour if there is none: then the three channels are colours."""
    layers = sorted({int(key.split(".")[1]) for key in model.state if _is_layer(key)})
    if not layers:
        return RgbColour()
    if model.settings.get("rgbnet_full_implicit") is True:
        raise InvalidFile(
            Problem("model_kwargs", "has rgbnet_full_implicit: colours without a grid", "a model with k0")
        )
    stems = []
    for number in layers:
        names = f"rgbnet.{number}", f"rgbnet.{number}.0"
        stems.append(next(each for each in names if f"{each}.weight" in model.state))
    weights, biases = model.layers(stems, [f"rgbnet.{number}" for number in layers])
    frequencies = model.floats("viewfreq", (model.any("viewfreq").size,))
    positions = model.of_2021 and "posfreq" in model.state
    sines = model.floats("posfreq", (model.any("posfreq").size,)) if positions else np.zeros(0)
    return MlpColour(
        *layers_of(weights, biases),
        frequencies=tuple(frequencies.tolist()),
        direct=model.settings.get("rgbnet_direct", False) is True,
        encoded=POSITIONS if positions else 0,
        feature_frequencies=tuple(sines.tolist()),
    )


def _is_layer(key: Any) -> bool:
    """Check for keys such as rgbnet.0.weight, rgbnet.2.0.weight, ..., rgbnet.3.weight."""
    match key.split(".") if isinstance(key, str) else []:
        case ["rgbnet", number, "weight"] | ["rgbnet", number, "0", "weight"]:
            return number.isascii() and number.isdecimal() and len(number) < 3
    return False


Nodes = npt.NDArray[np.int32]


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with the settings of DirectVoxGO."""
    return mentions(view, b"model_kwargs")


def decode(view: memoryview) -> LatticeField:
    """Return the lattice of a checkpoint."""
    model = DvgoModel(view)
    if model.settings.get("density_type") == "VDBGrid" and "density.grid" not in model.state:
        found = "has density_type VDBGrid: a PlenVDB model, whose grids are in other files of its folder"
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


def _dialect(model: DvgoModel) -> str:
    if model.of_2021:
        return "DirectVoxGO, 2021"
    return "DirectVoxGO" if "density.grid" in model.state else "DirectVoxGO, early 2022"


def _features(model: DvgoModel, links: Nodes, channels: int) -> npt.NDArray[Any]:
    """Return the features of every node, (n, C), x-major. Each channel is contiguous, as in the file."""
    if "k0.xy_plane" in model.state:
        return _of_planes(model, links, channels)
    features = _grid(model, "k0", channels)
    if features.shape[1:] != links.shape:
        raise InvalidFile(Problem("k0", f"has {features.shape[1:]} nodes", f"{links.shape}, as density has"))
    return features.reshape(channels, -1).T


def _of_planes(model: DvgoModel, links: Nodes, channels: int) -> Singles:
    """Compute the features from planes and vectors (DirectVoxGO's TensoRFGrid)."""
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
            raise InvalidFile(Problem(name, f"has {array.shape[:2]} nodes", "nodes along one axis"))
        lines[name] = array[:, 0]
    factors = factors_of(planes, lines, model.single("k0.f_vec"), "k0.f_vec")
    if shape_of(factors) != links.shape:
        raise InvalidFile(Problem("k0", f"has {shape_of(factors)} nodes", f"{links.shape}, as density has"))
    if factors.matrix.shape[1] != channels:
        raise InvalidFile(Problem("k0.f_vec", f"has {factors.matrix.shape[1]} columns", f"{channels}"))
    return rows_of(links, links.size, factors, "k0")


def _with_places(features: npt.NDArray[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Append three features: the position of a node in the box, 0 to 1.

    Positions are linear, so interpolation between the nodes is exact.
    """
    n, channels = features.shape
    memory.hold("k0", 4 * n * (channels + POSITIONS))
    rows = np.empty((channels + POSITIONS, n), np.float32)
    rows[:channels] = features.T
    for axis, edge in enumerate(shape):
        along = np.linspace(0, 1, edge, dtype=np.float32).reshape([-1 if i == axis else 1 for i in range(3)])
        rows[channels + axis] = np.broadcast_to(along, shape).reshape(-1)
    return rows.T


def _grid(model: DvgoModel, name: str, channels: int) -> Singles:
    """Return the grid `name`.grid, or `name` in files from before April 2022, as (C, X, Y, Z)."""
    key = name if name in model.state and f"{name}.grid" not in model.state else f"{name}.grid"
    array = model.single(key)
    if array.ndim != 5 or array.shape[0] != 1 or array.shape[1] != channels:
        allowed = f"(1, {channels}, X, Y, Z)"
        raise InvalidFile(Problem(key, f"has shape {array.shape}", allowed))
    found: Singles = array[0]
    return found
