"""K-Planes, the plug-in kplanes-nerfstudio of nerfstudio: products of three planes, and tiny-cuda-nn's networks.

    field.grids.{s}.plane_coefs.{c}   (C, H, W) for c across x and y, x and z, y and z; W is along the first axis
    field.sigma_net.params            64 units; outputs 0 to 14 go on, output 15 is the density: e^(output - 1)
    field.color_net.params            64, 64 units; 16 spherical harmonics, 15 features, the appearance
    field.appearance_ambedding.embedding.weight  (pictures, A), if there is one; its mean is used

The features of the scales are concatenated, or added. Positions outside of the box have the values of its faces, which
are empty space here. Source: docs/fields.md, "Programs"; kplanes_field.py.
"""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field import tcnn
from nerfbake.formats.field.nerfacto import mean_appearance
from nerfbake.formats.field.run_files import Run
from nerfbake.formats.field.torch_model import TorchModel
from nerfbake.kernels.arrays import Singles
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import MAX_LEVELS, HeadColour, Mlp, Network, PlaneProducts

_PLANES = "field.grids.{}.plane_coefs.{}"
KPLANES = _PLANES.format(0, 0)  # in the state of this model only
_TIME = _PLANES.format(0, 3)
_SIGMA, _COLOUR = "field.sigma_net.params", "field.color_net.params"
_APPEARANCE = "field.appearance_ambedding.embedding.weight"
_CODE, _OUTPUTS = 16, 16


def field_of_kplanes(model: TorchModel, run: Run) -> FunctionField:
    """Return the field of a model. Raises InvalidFile, MemoryLimit."""
    if _TIME in model.state:
        raise InvalidFile(Problem("pipeline", "is a scene that changes with time: it has six planes", "three planes"))
    if "field.color_basis.params" in model.state:
        raise InvalidFile(Problem("pipeline", "has a linear decoder (linear_decoder: true)", "networks"))
    contracted = run.flag("is_contracted", False)
    aabb, cube = model.floats("field.aabb", (2, 3)), np.array([[-1.0] * 3, [1.0] * 3])
    notes = ("outside of the box, where the program repeats what is at its faces, is empty space",)
    return FunctionField(
        network=_network(model, run),
        frame=run.frame,
        box=cube if contracted else aabb,
        unit=2 * cube if contracted else aabb,
        contracted=contracted,
        cameras=run.cameras,
        background=run.background("white"),
        near=run.number("near_plane", 2.0, low=0.0, high=1e9),
        far=run.number("far_plane", 6.0, low=0.0, high=1e9),
        dialect="K-Planes",
        notes=(*run.notes, *(() if contracted else notes), *model.file.notes),
    )


def _network(model: TorchModel, run: Run) -> Network:
    planes = _planes(model, concatenated=run.flag("concat_features_across_scales", True))
    params = model.single(_SIGMA).reshape(-1)
    width = tcnn.width_for(len(params), inputs=planes.features, hidden=1, outputs=_OUTPUTS, name=_SIGMA)
    trunk = tcnn.mlp_of(params, tcnn.Perceptron(planes.features, width, 1, _OUTPUTS, ones=True), _SIGMA)
    appearance = mean_appearance(model, _APPEARANCE)
    if not run.flag("use_average_appearance_embedding", True):
        appearance = np.zeros_like(appearance)
    head = _head(model, appearance)
    density = np.zeros(_OUTPUTS, np.float32)
    density[-1] = 1
    return Network(planes, trunk, density, 0.0, Activation("exponential", -1.0), HeadColour(head, "SH16"))


def _head(model: TorchModel, appearance: Singles) -> Mlp:
    """Return the perceptron of the colours, with its inputs in the order of HeadColour."""
    features, inputs = _OUTPUTS - 1, _CODE + _OUTPUTS - 1 + len(appearance)
    params = model.single(_COLOUR).reshape(-1)
    width = tcnn.width_for(len(params), inputs=inputs, hidden=2, outputs=3, name=_COLOUR)
    head = tcnn.mlp_of(params, tcnn.Perceptron(inputs, width, 2, 3, ones=True), _COLOUR)
    first = head.weights[0]
    own = np.zeros((len(first), _OUTPUTS + _CODE), np.float32)
    own[:, :features], own[:, _OUTPUTS:] = first[:, _CODE : _CODE + features], first[:, :_CODE]
    bias = tcnn.bias_with(head.biases[0], first[:, _CODE + features :], appearance)
    return Mlp((own, *head.weights[1:]), (bias, *head.biases[1:]))


def _planes(model: TorchModel, *, concatenated: bool) -> PlaneProducts:
    """Read the planes of all scales, with the channels last."""
    found, nodes = list[list[Singles]](), list[tuple[int, int, int]]()
    for s in range(MAX_LEVELS):
        if _PLANES.format(s, 0) not in model.state:
            break
        names = [_PLANES.format(s, c) for c in range(3)]
        scale = [model.single(name) for name in names]
        for name, plane in zip(names, scale, strict=True):
            if plane.ndim != 3:
                raise InvalidFile(Problem(name, f"has shape {plane.shape}", "(channels, rows, columns)"))
        (C, Y, X), Z = scale[0].shape, scale[1].shape[1]
        for name, plane, shape in zip(names, scale, [(C, Y, X), (C, Z, X), (C, Z, Y)], strict=True):
            if plane.shape != shape or len(plane) != (found[0] if found else scale)[0].shape[0]:
                raise InvalidFile(Problem(name, f"has shape {plane.shape}", f"{shape}, as the other planes"))
        found.append(scale)
        nodes.append((X, Y, Z))
    count = sum(plane.size for scale in found for plane in scale)
    memory.hold("the planes", 4 * count)
    values, at = np.empty(count, np.float32), 0
    for scale in found:
        for plane in scale:
            values[at : at + plane.size] = plane.transpose(1, 2, 0).reshape(-1)
            at += plane.size
    return PlaneProducts(values, np.array(nodes, np.int64), found[0][0].shape[0], concatenated)
