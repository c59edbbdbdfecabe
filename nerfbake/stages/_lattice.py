"""Evaluate a lattice field: densities and colours at points, and fits of its colours by SH behind a sigmoid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Floats, Ints, Points, Singles, as_input
from nerfbake.kernels.lattice import harmonics
from nerfbake.kernels.lattice.blocks import NO_PLANES, BlockNodes, sums_at
from nerfbake.kernels.lattice.mlp import layers_for, logits_along, positional_encoding, project_logits
from nerfbake.kernels.lattice.nodes import (
    EXPONENTIAL,
    OPACITY,
    RELU,
    SOFTPLUS,
    DensityNodes,
    cells_in,
    in_nodes,
    interpolate_rows,
    nearest_in,
)
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci, log, sigmoid
from nerfbake.kernels.octree.node_values import to_float32
from nerfbake.scene.basis import SH0
from nerfbake.scene.lattice_field import Blocks, DeferredColour, LatticeField, MlpColour, ShColour
from nerfbake.stages._deferred import colour_function, diffuse_and_inputs, fit_of_deferred

DIRECTIONS = 256  # directions in which coefficients are fitted to colours
# Fewer directions for an MLP, because its evaluation takes most of the time. RMS in 400 other directions, for an MLP
# fitted to the chair's colours: SH4 12.49 with 24 directions and 12.47 with 256; SH9 2.18 with 48, 2.15 with 64 and
# 2.11 with 256; SH25 1.85 with 100 and 1.81 with 256.
MLP_DIRECTIONS, FEW_DIRECTIONS = 64, 24
_KINDS = {"relu": RELU, "softplus": SOFTPLUS, "opacity": OPACITY, "exponential": EXPONENTIAL}

Looked = Callable[[Floats], Singles]
Seen = Callable[[Singles, Ints], Singles]
Fit = Callable[[Singles], Singles]


def nodes_of(lattice: LatticeField) -> DensityNodes:
    """Return the lattice's densities as arguments for the kernels."""
    kind, shift, scale = lattice.activation
    mask = np.ones((1, 1, 1), bool) if lattice.occupied is None else np.ascontiguousarray(lattice.occupied)
    least = -float(log(1 - lattice.least)) / lattice.step
    links, density = as_input(lattice.links), as_input(lattice.density)
    corners = int(lattice.at_corners)
    own = lattice.mask_box
    times, plus = nearest_in(mask) if own is None else cells_in(mask, lattice.box, own)
    nodes = DensityNodes(links, density, mask, times, plus, corners, _KINDS[kind], float(shift), float(scale), least)
    if lattice.blocks is None:
        return nodes
    planes = NO_PLANES if lattice.planes is None else np.ascontiguousarray(lattice.planes.density)
    return nodes._replace(**_blocks(lattice, lattice.blocks)._asdict(), planes=planes)


def _blocks(lattice: LatticeField, blocks: Blocks) -> BlockNodes:
    """Return the positions of the blocks and of the planes' nodes as arguments for the kernels."""
    times, plus = cells_in(lattice.links >= 0, lattice.box, blocks.box)
    planes = lattice.planes
    across, first = (0.0, 0.0) if planes is None else (float(planes.across), float(planes.first))
    return BlockNodes(as_input(lattice.links), blocks.edge, times, plus, across, first)


def features_of(lattice: LatticeField) -> Looked:
    """Return a function of places (m, 3) in the box to interpolated features (m, C). Raises MemoryLimit."""
    memory.require("the lattice's colours", 4 * lattice.n * lattice.features.shape[1])
    table = table_of(lattice)
    if lattice.blocks is None:
        return lambda places: interpolate_rows(
            lattice.links, table, in_nodes(places, lattice.shape, lattice.at_corners)
        )
    blocks, C = _blocks(lattice, lattice.blocks), table.shape[1]
    planes = np.zeros((3, 0, 0, C), np.float32)
    if lattice.planes is not None:
        planes = np.ascontiguousarray(lattice.planes.features)
    return lambda places: sums_at(blocks, table, planes, places)


def table_of(lattice: LatticeField, rows: npt.NDArray[np.int32] | slice = slice(None)) -> Singles:
    """Return the features (m, C) of some rows, or of all, as a contiguous float32 array."""
    return np.ascontiguousarray(to_float32(lattice.features[rows]), np.float32)


def places_of(lattice: LatticeField, points: Points) -> Points:
    """Return points (m, 3) in the world as fractions of the lattice's box."""
    return np.asarray((points - lattice.box[0]) / (lattice.box[1] - lattice.box[0]), np.float64)


def seen_along(lattice: LatticeField, directions: Points) -> Seen:
    """Return a function of features (k, C) and indices (k,) into `directions` to colours (k, 3), which are >= 0."""
    if isinstance(lattice.colour, ShColour):
        basis = sh_basis(directions, lattice.colour.size, np.float32)
        return lambda features, ray: harmonics.evaluate_colours(features, basis, ray)
    if isinstance(lattice.colour, MlpColour):
        whole, layers = lattice.colour, layers_for(directions, lattice.colour.frequencies, *lattice.colour.weights)

        def seen(features: Singles, ray: Ints) -> Singles:
            own, added = _split(whole, features)
            return sigmoid(logits_along(own, layers, ray) + added).astype(np.float32)

        return seen
    if isinstance(lattice.colour, DeferredColour):
        shown = colour_function(lattice.colour, directions)
        whole_colour = lattice.colour
        return lambda features, ray: shown(diffuse_and_inputs(whole_colour, features), ray)
    return lambda features, ray: sigmoid(features).astype(np.float32)


def fit_of(lattice: LatticeField, B: int) -> Fit:
    """Return a function of features (m, C) to SH coefficients (m, 3 B) of colours behind a sigmoid."""
    if isinstance(lattice.colour, ShColour):
        directions = fibonacci(DIRECTIONS)
        basis = sh_basis(directions, lattice.colour.size, np.float32)
        inverse = harmonics.inverse_of(sh_basis(directions, B))
        return lambda features: harmonics.refit_coefficients(features, basis, inverse)
    if isinstance(lattice.colour, MlpColour):
        count = FEW_DIRECTIONS if B <= 4 else max(MLP_DIRECTIONS, 4 * B)
        directions, whole = fibonacci(count), lattice.colour
        layers = layers_for(directions, whole.frequencies, *whole.weights)
        inverse = harmonics.inverse_of(sh_basis(directions, B))

        def fit(features: Singles) -> Singles:
            own, added = _split(whole, features)
            return project_logits(own, layers, inverse) + _constant(added, B)

        return fit
    if isinstance(lattice.colour, DeferredColour):
        deferred, fit_inputs = lattice.colour, fit_of_inputs(lattice.colour, B)
        return lambda features: fit_inputs(diffuse_and_inputs(deferred, features))
    return lambda features: _constant(features, B)


def fit_of_inputs(colour: DeferredColour, B: int) -> Fit:
    """Like fit_of(), for values of diffuse_and_inputs() (m, 3 + others)."""
    return fit_of_deferred(colour, fibonacci(max(MLP_DIRECTIONS, 4 * B)), B)


def _split(mlp: MlpColour, features: Singles) -> tuple[Singles, Singles]:
    """Return the features that are inputs of the MLP, and those (m, 3) that are added to its logits."""
    own, added = features, np.zeros((len(features), 3), np.float32)
    if not mlp.direct:
        own, added = np.ascontiguousarray(features[:, 3:]), features[:, :3]
    if mlp.feature_frequencies and mlp.encoded:
        sines = positional_encoding(own[:, -mlp.encoded :].astype(np.float64), mlp.feature_frequencies)[
            :, mlp.encoded :
        ]
        own = np.concatenate([own, sines.astype(np.float32)], axis=1)
    return own, added


def _constant(features: Singles, B: int) -> Singles:
    """Return coefficients of colours that do not depend on the direction: only the first of each channel is not 0."""
    out = np.zeros((len(features), 3 * B), np.float32)
    out[:, ::B] = features / np.float32(SH0)
    return out
