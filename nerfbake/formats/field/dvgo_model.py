"""What DirectVoxGO's checkpoints hold beside their grids, which PlenVDB keeps in files of their own.

Keys: docs/formats/checkpoints.md. The grids of the optimiser's state, two more of each, are never looked at.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.torch_model import TorchModel, layers_of
from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.maths.elementary import log, power
from nerfbake.scene.lattice_field import Activation, Colour, LatticeField, MlpColour, RgbColour

_LEAST = 1e-4  # the opacity of a step below which its renderer skips a sample
# What other lattices than a box of the world's are told by, and what they are.
_REFUSED = {
    "mpi_depth": "a forward-facing scene (NDC), whose lattice is no box of the world",
    "scene_center": "an unbounded scene, whose lattice is contracted",
}
_FLAGS = {  # of DirectVoxGO before February 2022
    "nearest": "values of the nearest node, not between nodes",
    "pre_act_density": "opacities at the nodes, not densities",
    "in_act_density": "densities that are activated at the nodes",
}
_NO_MASK = "the mask that a coarse lattice makes is left out; nodes that it leaves out are empty by themselves"
POSITIONS = 3  # features that a file does not hold: where a node stands in the box


class Model(TorchModel):
    """A checkpoint: its settings, and the arrays of the model's state by their keys."""

    def __init__(self, view: memoryview) -> None:
        super().__init__(view, "model_kwargs", "model_state_dict", "DirectVoxGO")
        for key, what in _REFUSED.items():
            if key in self.settings:
                raise InvalidFile(Problem("model_kwargs", f"has {key}: {what}", "a bounded scene of DirectVoxGO"))
        if "act_shift.grid" in self.state:
            found = "has act_shift.grid: a forward-facing scene (NDC), whose lattice is no box of the world"
            raise InvalidFile(Problem("model_state_dict", found, "a bounded scene of DirectVoxGO"))
        for key, what in _FLAGS.items():
            if self.settings.get(key, False) is not False:
                raise InvalidFile(Problem("model_kwargs", f"has {key}: {what}", "False, as its own settings have it"))

    @property
    def of_2021(self) -> bool:
        """True before February 2022, when MLPs asked for positions, and no opacity was too small to count."""
        return "posbase_pe" in self.settings

    def lattice(
        self, links: npt.NDArray[np.int32], density: Singles, features: npt.NDArray[Any], colour: Colour, dialect: str
    ) -> LatticeField:
        """The lattice of these nodes: links, density (n,) and features (n, C) as scene.lattice_field has them."""
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
        """Where a sample counts that is nearest to it; None where the model says nothing of it."""
        if "mask_cache.mask" not in self.state:
            return None
        mask = self.any("mask_cache.mask")
        if mask.dtype != np.bool_ or mask.ndim != 3:
            found = f"has dtype {mask.dtype}, shape {mask.shape}"
            raise InvalidFile(Problem("mask_cache.mask", found, "bool (X, Y, Z)"))
        return mask

    def _shift(self) -> float:
        """What training left of it; before it was kept, what alpha_init makes."""
        if "act_shift" in self.state:
            return float(self.floats("act_shift", (1,))[0])
        alpha = self.settings.get("alpha_init")
        if type(alpha) is not float or not 0 < alpha < 1:
            raise InvalidFile(Problem("model_kwargs", "has no alpha_init, and the model no act_shift", "one of them"))
        return float(log(1 / (1 - alpha) - 1))

    def _voxel_size(self, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64]) -> float:
        """The edge of the voxel that opacities are reckoned with, in world units."""
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
            raise InvalidFile(Problem("num_voxels_base", found, "1 or more, over a box with a volume"))
        return float(power(volume / count, 1 / 3))


def _threshold(settings: dict[Any, Any]) -> float:
    """The opacity of a step below which a sample is skipped; of several by step of training, the last."""
    value = settings.get("fast_color_thres", _LEAST)
    if isinstance(value, dict) and value:
        value = value[max(value, key=lambda key: key if isinstance(key, int) else -1)]
    if type(value) not in (int, float) or not 0 <= value < 1:
        raise InvalidFile(Problem("fast_color_thres", "is no opacity", "0 to 1, without 1"))
    return float(value)


def colour_of(model: Model) -> Colour:
    """The MLP, or without one three channels that are colours themselves."""
    layers = sorted({int(key.split(".")[1]) for key in model.state if _is_layer(key)})
    if not layers:
        return RgbColour()
    if model.settings.get("rgbnet_full_implicit") is True:
        raise InvalidFile(Problem("model_kwargs", "has rgbnet_full_implicit: colours without a grid", "one with k0"))
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
    """rgbnet.0.weight, rgbnet.2.0.weight, ..., rgbnet.3.weight."""
    match key.split(".") if isinstance(key, str) else []:
        case ["rgbnet", number, "weight"] | ["rgbnet", number, "0", "weight"]:
            return number.isascii() and number.isdecimal() and len(number) < 3
    return False
