"""Lattice field and camera -> picture as in the lattice's original program, and the colour error of its octree."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.lattice.nodes import DensityNodes, densities
from nerfbake.kernels.lattice.rays import Samples, composite_colours, composite_values, samples_of
from nerfbake.kernels.maths.elementary import fibonacci, sigmoid
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.octree.pyramid import opacity
from nerfbake.scene.camera import Camera, require_cut
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.lattice_field import DeferredColour, LatticeField
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages._basis_functions import basis_at
from nerfbake.stages._deferred import colour_function, diffuse_and_inputs
from nerfbake.stages._lattice import Looked, features_of, nodes_of, places_of, seen_along
from nerfbake.stages._supersampled import supersampled
from nerfbake.stages.scene_to_field import build_field_from_octree

_SEEN = 1 / 255  # smallest alpha of a ray for which an MLP is evaluated
_RAYS = 1 << 13  # rays at a time, which limits the memory for their samples


def render_lattice(
    lattice: LatticeField,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
    samples: int = 1,
) -> Image:
    """Render the lattice as seen by a camera. Samples are half a node apart, interpolated first and then activated.

    For background, transmittance_cut and samples, and for the values of a pixel, see render_field(). Colours are
    clamped at 1 after the sum along a ray. The MLP of a deferred colour is evaluated once per ray, for the ray's sums
    with the background behind them. Raises InvalidScene for a lattice that cannot be rendered; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import LatticeField, orbit_cameras, render_lattice
    >>> from nerfbake.scene.lattice_field import Activation, RgbColour
    >>> links = np.arange(8, dtype=np.int32).reshape(2, 2, 2)
    >>> box, grey = np.array([[0.0] * 3, [1.0] * 3]), np.zeros((8, 3), np.float32)
    >>> lattice = LatticeField(links, np.full(8, 50, np.float32), grey, Activation(), RgbColour(), box)
    >>> image = render_lattice(lattice, orbit_cameras(lattice, width=16, height=12).cameras[0])
    >>> bool(image.alpha.max() > 0.9)
    True
    """
    lattice.require_usable()
    require_cut(transmittance_cut)
    nodes, looked = nodes_of(lattice), features_of(lattice)
    return supersampled(
        lambda part: _rendered(lattice, nodes, looked, part, background, transmittance_cut), camera, samples
    )


def _rendered(
    lattice: LatticeField,
    nodes: DensityNodes,
    looked: Looked,
    camera: Camera,
    background: tuple[float, float, float] | None,
    cut: float,
) -> Image:
    """Render with one ray per pixel."""
    camera.require_memory(200)
    origin, looks = camera.rays()
    out = np.empty((len(looks), 5), np.float32)
    for begin in range(0, len(looks), _RAYS):
        some = looks[begin : begin + _RAYS]
        out[begin : begin + len(some)] = _along(lattice, nodes, looked, origin, some, float(cut), background)
    shape = (camera.height, camera.width)
    colour, alpha, far = np.minimum(out[:, :3], 1), out[:, 3], out[:, 4]
    if background is not None:
        colour = colour + (1 - alpha[:, None]) * np.array(background, np.float32)
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    return Image(np.minimum(colour, 1).reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), background)


def _along(
    lattice: LatticeField,
    nodes: DensityNodes,
    looked: Looked,
    origin: Floats,
    looks: Floats,
    cut: float,
    background: tuple[float, float, float] | None,
) -> Floats:
    """Return for each ray (m, 5): colour weighted by opacity, alpha, and the sum of opacity times distance."""
    ways = looks / (lattice.box[1] - lattice.box[0])
    met = samples_of(nodes, places_of(lattice, origin), ways, lattice.step, cut)
    k = len(met.weights)
    memory.require("the samples along the rays", k * (4 * lattice.features.shape[1] + 40))
    ray = np.repeat(np.arange(len(looks)), np.diff(met.first))
    features = looked(met.places)
    if isinstance(lattice.colour, DeferredColour):
        return np.column_stack([_deferred(lattice.colour, met, features, looks, background), met.lost])
    colours = composite_colours(met, seen_along(lattice, looks)(features, ray))
    return np.column_stack([colours, met.lost])


def _deferred(
    colour: DeferredColour,
    met: Samples,
    features: Singles,
    looks: Floats,
    background: tuple[float, float, float] | None,
) -> Floats:
    """Return the colours of rays (m, 3) including the output of the MLP, without the background."""
    sums = composite_values(met, diffuse_and_inputs(colour, features))
    behind = (1 - met.lost[:, :1]) * np.array(background or (0, 0, 0))
    sums[:, :3] += behind
    shown = colour_function(colour, looks)(sums, np.arange(len(looks)))
    return np.asarray(np.where(met.lost[:, :1] >= _SEEN, shown, sums[:, :3]) - behind, np.float64)


_LEAST = 1e-300  # smallest divisor, for the case that all weights are 0
LEAVES, DIRECTIONS = 2000, 400  # numbers that are compared; the directions differ from those of the fit


def measure_lattice(lattice: LatticeField, octree: SparseVoxelOctree | RadianceField) -> float:
    """Return the RMS error of an octree's colours, in 0..255, against the lattice it was built from.

    Colours are compared at the centres of at most 2,000 evenly chosen leaves, in 400 directions that differ from those
    of the fit. Leaves are weighted by their opacity. octree: you can also pass its field, if you have already built it
    with build_field_from_octree(). Raises InvalidScene for broken scenes, and for an octree without visible leaves.

    >>> import numpy as np
    >>> from nerfbake import LatticeField, measure_lattice, build_octree_from_lattice
    >>> from nerfbake.scene.lattice_field import Activation, RgbColour
    >>> links = np.arange(27, dtype=np.int32).reshape(3, 3, 3)
    >>> box, grey = np.array([[0.0] * 3, [1.0] * 3]), np.zeros((27, 3), np.float32)
    >>> lattice = LatticeField(links, np.ones(27, np.float32), grey, Activation(), RgbColour(), box)
    >>> measure_lattice(lattice, build_octree_from_lattice(lattice)) < 1e-3
    True
    """
    lattice.require_usable()
    field = octree if isinstance(octree, RadianceField) else build_field_from_octree(octree)
    points = field.leaf_centres(LEAVES)
    if not len(points):
        raise InvalidScene(Problem("the octree", "is empty", "a leaf with a density above 0"))
    values, directions = field.sample(points), fibonacci(DIRECTIONS)
    B = field.basis.size
    places = places_of(lattice, points)
    features = features_of(lattice)(places)
    seen = seen_along(lattice, directions)
    weight = opacity(values[:, -1], lattice.step)
    across = np.ascontiguousarray(basis_at(field.basis, directions).T)
    if lattice.blocks is not None:  # the centre of a voxel that was averaged over samples may be in an empty block
        weight = np.where(densities(nodes_of(lattice), places) > 0, weight, 0)
    memory.require("the colours in all directions", 24 * len(points) * DIRECTIONS)
    sums = np.stack([product(values[:, c * B : (c + 1) * B], across) for c in range(3)], axis=2)
    total = 0.0
    for j in range(DIRECTIONS):
        truth = np.clip(seen(features, np.full(len(points), j)), 0, 1)
        total += float((((sigmoid(sums[:, j]) - truth) ** 2).sum(axis=1) * weight).sum())
    return 255 * float(np.sqrt(total / max(3 * DIRECTIONS * weight.sum(), _LEAST)))
