"""What stages ask of a lattice field: densities and colours at places, and coefficients of a sigmoid's sums."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Floats, Ints, Points, Singles
from nerfbake.kernels.lattice import harmonics
from nerfbake.kernels.lattice.blocks import NO_PLANES, BlockNodes, sums_at
from nerfbake.kernels.lattice.mlp import encoded, layers_for, logits_along, projected
from nerfbake.kernels.lattice.nodes import (
    EXPONENTIAL,
    OPACITY,
    RELU,
    SOFTPLUS,
    Nodes,
    blended,
    cells_in,
    in_nodes,
    nearest_in,
)
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import log, sigmoid
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.kernels.octree.halves import widened
from nerfbake.scene.lattice_field import Blocks, DeferredColour, LatticeField, MlpColour, ShColour
from nerfbake.stages._deferred import bare, fit_of_deferred, seen_of

DIRECTIONS = 256  # in which colours are compared while coefficients are chosen
# The same of an MLP, whose time they are. Of one fitted to the chair's colours, RMS in 400 others: SH4 12.49 in 24 and
# 12.47 in 256, SH9 2.18 in 48, 2.15 in 64 and 2.11 in 256, SH25 1.85 in 100 and 1.81 in 256.
MLP_DIRECTIONS, FEW_DIRECTIONS = 64, 24
_KINDS = {"relu": RELU, "softplus": SOFTPLUS, "opacity": OPACITY, "exponential": EXPONENTIAL}
_Y0 = 0.28209479177387814  # the first of the spherical harmonics, a constant

Looked = Callable[[Floats], Singles]
Seen = Callable[[Singles, Ints], Singles]
Fit = Callable[[Singles], Singles]


def nodes_of(lattice: LatticeField) -> Nodes:
    """Its densities, as kernels take them."""
    kind, shift, scale = lattice.activation
    mask = np.ones((1, 1, 1), bool) if lattice.occupied is None else np.ascontiguousarray(lattice.occupied)
    least = -float(log(1 - lattice.least)) / lattice.step
    density = np.ascontiguousarray(lattice.density)
    corners = int(lattice.at_corners)
    own = lattice.mask_box
    times, plus = nearest_in(mask) if own is None else cells_in(mask, lattice.box, own)
    nodes = Nodes(lattice.links, density, mask, times, plus, corners, _KINDS[kind], float(shift), float(scale), least)
    if lattice.blocks is None:
        return nodes
    planes = NO_PLANES if lattice.planes is None else np.ascontiguousarray(lattice.planes.density)
    return nodes._replace(**_blocks(lattice, lattice.blocks)._asdict(), planes=planes)


def _blocks(lattice: LatticeField, blocks: Blocks) -> BlockNodes:
    """Where these and the nodes of its planes are, as kernels take them."""
    times, plus = cells_in(lattice.links >= 0, lattice.box, blocks.box)
    planes = lattice.planes
    across, first = (0.0, 0.0) if planes is None else (float(planes.across), float(planes.first))
    return BlockNodes(np.ascontiguousarray(lattice.links), blocks.edge, times, plus, across, first)


def features_of(lattice: LatticeField) -> Looked:
    """What looks features (m, C) up at places (m, 3) in the box. Raises MemoryLimit."""
    memory.require("the lattice's colours", 4 * lattice.n * lattice.features.shape[1])
    table = table_of(lattice)
    if lattice.blocks is None:
        return lambda places: blended(lattice.links, table, in_nodes(places, lattice.shape, lattice.at_corners))
    blocks, C = _blocks(lattice, lattice.blocks), table.shape[1]
    planes = np.zeros((3, 0, 0, C), np.float32)
    if lattice.planes is not None:
        planes = np.ascontiguousarray(lattice.planes.features)
    return lambda places: sums_at(blocks, table, planes, places)


def table_of(lattice: LatticeField, rows: npt.NDArray[np.int32] | slice = slice(None)) -> Singles:
    """(m, C) the features of some rows, or of all, lying together."""
    return np.ascontiguousarray(widened(lattice.features[rows]), np.float32)


def places_of(lattice: LatticeField, points: Points) -> Points:
    """Points (m, 3) of the world as shares of the lattice's box."""
    return np.asarray((points - lattice.box[0]) / (lattice.box[1] - lattice.box[0]), np.float64)


def seen_along(lattice: LatticeField, directions: Points) -> Seen:
    """What makes colours (k, 3) of features (k, C), each in the direction with its number (k,); 0 or more."""
    if isinstance(lattice.colour, ShColour):
        basis = sh_basis(directions, lattice.colour.size, np.float32)
        return lambda features, ray: harmonics.shown(features, basis, ray)
    if isinstance(lattice.colour, MlpColour):
        whole, layers = lattice.colour, layers_for(directions, lattice.colour.frequencies, *lattice.colour.weights)

        def seen(features: Singles, ray: Ints) -> Singles:
            own, added = _split(whole, features)
            return sigmoid(logits_along(own, layers, ray) + added).astype(np.float32)

        return seen
    if isinstance(lattice.colour, DeferredColour):
        shown = seen_of(lattice.colour, directions)
        whole_colour = lattice.colour
        return lambda features, ray: shown(bare(whole_colour, features), ray)
    return lambda features, ray: sigmoid(features).astype(np.float32)


def fit_of(lattice: LatticeField, B: int) -> Fit:
    """What makes the 3 B coefficients of a sigmoid's sums of features (m, C)."""
    if isinstance(lattice.colour, ShColour):
        directions = fibonacci(DIRECTIONS)
        basis = sh_basis(directions, lattice.colour.size, np.float32)
        inverse = harmonics.inverse_of(sh_basis(directions, B))
        return lambda features: harmonics.refitted(features, basis, inverse)
    if isinstance(lattice.colour, MlpColour):
        count = FEW_DIRECTIONS if B <= 4 else max(MLP_DIRECTIONS, 4 * B)
        directions, whole = fibonacci(count), lattice.colour
        layers = layers_for(directions, whole.frequencies, *whole.weights)
        inverse = harmonics.inverse_of(sh_basis(directions, B))

        def fit(features: Singles) -> Singles:
            own, added = _split(whole, features)
            return projected(own, layers, inverse) + _constant(added, B)

        return fit
    if isinstance(lattice.colour, DeferredColour):
        deferred, fit_bare = lattice.colour, fit_of_bare(lattice.colour, B)
        return lambda features: fit_bare(bare(deferred, features))
    return lambda features: _constant(features, B)


def fit_of_bare(colour: DeferredColour, B: int) -> Fit:
    """The same of a deferred colour's bare values (m, 3 + others)."""
    return fit_of_deferred(colour, fibonacci(max(MLP_DIRECTIONS, 4 * B)), B)


def _split(mlp: MlpColour, features: Singles) -> tuple[Singles, Singles]:
    """What goes through the MLP, and (m, 3) what is added to its logits."""
    own, added = features, np.zeros((len(features), 3), np.float32)
    if not mlp.direct:
        own, added = np.ascontiguousarray(features[:, 3:]), features[:, :3]
    if mlp.feature_frequencies and mlp.encoded:
        sines = encoded(own[:, -mlp.encoded :].astype(np.float64), mlp.feature_frequencies)[:, mlp.encoded :]
        own = np.concatenate([own, sines.astype(np.float32)], axis=1)
    return own, added


def _constant(features: Singles, B: int) -> Singles:
    """The same in every direction: the first coefficient of each channel alone."""
    out = np.zeros((len(features), 3 * B), np.float32)
    out[:, ::B] = features / np.float32(_Y0)
    return out
