"""Read checkpoints of nerf-pytorch: `NNNNNN.tar` in a folder of logs, which torch writes.

    network_fn_state_dict, network_fine_state_dict    the coarse network, and the fine one, which is used if it exists
        pts_linears.{0..7}                 the encoded position; layer 5 also takes it, before the features
        alpha_linear                       density, per world unit, before ReLU
        feature_linear, views_linears.0    without ReLU; [features, encoded direction]
        rgb_linear                         colour, before the sigmoid
        output_linear                      without view directions: colour, density, and maybe a fifth row

Depths and the background are only in args.txt or config.txt beside the checkpoint, lines of `key = value`.

Source: docs/fields.md, "Programs".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.nerf_layers import (
    CORNER_NOTE,
    Layer,
    Order,
    after_features,
    box_note,
    columns_of,
    folded,
    frequencies_in,
    layer_names,
    layer_of,
    octaves,
    trunk_of,
    usual_box,
)
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.formats.wire.torch import mentions
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import HeadColour, Mlp, Network

_COARSE, _FINE = "network_fn_state_dict", "network_fine_state_dict"
_ORDER: Order = "by frequency"
_SETTINGS = ("args.txt", "config.txt")
_NEAR, _FAR = 2.0, 6.0  # of the scenes of Blender
_MOST_TEXT = 1 << 16  # bytes
_ONE_TIME = "a NeRF without a time axis"


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with nerf-pytorch's networks."""
    return mentions(view, _COARSE.encode())


def decode(view: memoryview, *, beside: Mapping[str, memoryview] | None = None) -> FunctionField:
    """Return the field of a checkpoint. beside: the files of its folder. Raises InvalidFile, MemoryLimit."""
    model = NerfModel(view)
    settings, found = _settings(beside or {})
    dataset = settings.get("dataset_type", "blender" if not found else "llff")
    if dataset == "llff" and settings.get("no_ndc") != "True":
        raise InvalidFile(
            Problem(found, "describes a forward-facing scene (NDC)", "a scene with no_ndc, or of Blender")
        )
    notes = [*model.file.notes, CORNER_NOTE]
    if not found:
        notes.append(f"{_SETTINGS[0]} is not beside it: depths of {_NEAR:g} to {_FAR:g} are assumed, as of Blender")
    elif dataset != "blender":
        notes.append(f"the depths of its {dataset[:40]} capture are not in {found}: {_NEAR:g} to {_FAR:g} are assumed")
    box = usual_box(_NEAR, _FAR)
    white = settings.get("white_bkgd") == "True"
    return FunctionField(
        network=_network(model),
        frame=np.eye(3, 4),
        box=box,
        background=((1.0,) * 3 if white else (0.0,) * 3) if found else None,
        near=_NEAR,
        far=_FAR,
        dialect="nerf-pytorch",
        notes=(*notes, box_note(box)),
    )


class NerfModel(TorchModel):
    """A checkpoint, with the arrays of its fine network, or of its only one."""

    def __init__(self, view: memoryview) -> None:
        super().__init__(view, _COARSE, _COARSE, "nerf-pytorch")
        if any(isinstance(key, str) and key.startswith(("_time", "_occ.")) for key in self.state):
            raise InvalidFile(Problem(_COARSE, "is a network of D-NeRF, whose scene changes with time", _ONE_TIME))
        fine = self.file.root.get(_FINE)
        if isinstance(fine, dict) and fine:
            self.state, self._place = fine, _FINE

    def layer(self, name: str) -> Layer:
        return layer_of(name, self.single(f"{name}.weight"), self.single(f"{name}.bias"))


def _network(model: NerfModel) -> Network:
    layers = [model.layer(name) for name in layer_names(model.state, "pts_linears")]
    trunk = trunk_of(layers, _ORDER, code_first=True)
    density, colour = _with_directions(model, trunk) if "rgb_linear.weight" in model.state else _without(model, trunk)
    encoding = octaves((trunk.inputs - 3) // 6)
    return Network(encoding, trunk, density.weight[0], float(density.bias[0]), Activation("relu"), colour)


def _with_directions(model: NerfModel, trunk: Mlp) -> tuple[Layer, HeadColour]:
    density, feature, view, rgb = map(model.layer, ("alpha_linear", "feature_linear", "views_linears.0", "rgb_linear"))
    density.require_inputs(trunk.outputs)
    density.require_outputs(1)
    feature.require_inputs(trunk.outputs)
    rgb.require_inputs(view.outputs)
    rgb.require_outputs(3)
    frequencies = frequencies_in(view, feature.outputs)
    own = after_features(view, columns_of(_ORDER, frequencies), code_first=False)
    first, bias = folded(view, own, feature)
    mlp = Mlp((first, rgb.weight), (bias, rgb.bias))
    return density, HeadColour(mlp, octaves(frequencies))


def _without(model: NerfModel, trunk: Mlp) -> tuple[Layer, HeadColour]:
    both = model.layer("output_linear")
    both.require_inputs(trunk.outputs)
    both.require_outputs(4, 5)
    density = Layer(both.name, both.weight[3:4], both.bias[3:4])
    return density, HeadColour(Mlp((both.weight[:3],), (both.bias[:3],)), "none")


def _settings(beside: Mapping[str, memoryview]) -> tuple[dict[str, str], str]:
    """Return the settings of the run, and the name of their file, '' if there is none."""
    for name in _SETTINGS:
        if name in beside:
            if len(beside[name]) > _MOST_TEXT:
                raise InvalidFile(Problem(name, f"has {len(beside[name]):,} bytes", f"{_MOST_TEXT:,} at most"))
            lines = bytes(beside[name]).decode("utf-8", "replace").splitlines()
            pairs = (line.partition("=") for line in lines if not line.lstrip().startswith("#"))
            return {key.strip(): value.strip() for key, equal, value in pairs if equal}, name
    return {}, ""
