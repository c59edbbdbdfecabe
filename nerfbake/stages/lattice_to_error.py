"""Lattice field and the octree made of it -> how far the octree's colours are off in other directions."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.lattice.nodes import densities
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.maths.products import product
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.kernels.octree.means import opacity
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages._basis_functions import basis_at
from nerfbake.stages._lattice import features_of, nodes_of, places_of, seen_along
from nerfbake.stages.octree_to_field import field_of_octree

_LEAST = 1e-300  # of what is divided by: nothing is seen there
LEAVES, DIRECTIONS = 2000, 400  # that are looked at; the directions are others than those of the fit


def measure_lattice(lattice: LatticeField, octree: SparseVoxelOctree | RadianceField) -> float:
    """The root of the mean square, in 0..255, of what the octree's leaves are off the lattice's own colours at their
    centres: in 400 directions other than those that its coefficients were chosen by, a leaf weighed by its opacity.
    octree: may be field_of_octree()'s field of it, where one is there.

    Of at most 2,000 leaves, evenly chosen. Raises InvalidScene for broken scenes, and for an octree that holds nothing.

    >>> import numpy as np
    >>> from nerfbake import LatticeField, measure_lattice, octree_of_lattice
    >>> from nerfbake.scene.lattice_field import Activation, RgbColour
    >>> links = np.arange(27, dtype=np.int32).reshape(3, 3, 3)
    >>> box, grey = np.array([[0.0] * 3, [1.0] * 3]), np.zeros((27, 3), np.float32)
    >>> lattice = LatticeField(links, np.ones(27, np.float32), grey, Activation(), RgbColour(), box)
    >>> measure_lattice(lattice, octree_of_lattice(lattice)) < 1e-3
    True
    """
    lattice.require_usable()
    field = octree if isinstance(octree, RadianceField) else field_of_octree(octree)
    points = field.leaf_centres(LEAVES)
    if not len(points):
        raise InvalidScene(Problem("the octree", "holds nothing", "a leaf with a density above 0"))
    values, directions = field.sample(points), fibonacci(DIRECTIONS)
    B = field.basis.size
    places = places_of(lattice, points)
    features = features_of(lattice)(places)
    seen = seen_along(lattice, directions)
    weight = opacity(values[:, -1], lattice.step)
    across = np.ascontiguousarray(basis_at(field.basis, directions).T)
    if lattice.blocks is not None:  # a voxel's mean may be of a face, whose centre is in an empty block
        weight = np.where(densities(nodes_of(lattice), places) > 0, weight, 0)
    memory.require("the colours in all directions", 24 * len(points) * DIRECTIONS)
    sums = np.stack([product(values[:, c * B : (c + 1) * B], across) for c in range(3)], axis=2)
    total = 0.0
    for j in range(DIRECTIONS):
        truth = np.clip(seen(features, np.full(len(points), j)), 0, 1)
        total += float((((sigmoid(sums[:, j]) - truth) ** 2).sum(axis=1) * weight).sum())
    return 255 * float(np.sqrt(total / max(3 * DIRECTIONS * weight.sum(), _LEAST)))
