"""Lattice field and camera -> picture, as the lattice's own program makes it: what a bake of it is judged by."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.lattice.nodes import Nodes
from nerfbake.kernels.lattice.rays import Samples, gathered, samples_of, summed
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.lattice_field import DeferredColour, LatticeField
from nerfbake.stages._deferred import bare, seen_of
from nerfbake.stages._lattice import Looked, features_of, nodes_of, places_of, seen_along
from nerfbake.stages._supersampled import supersampled

_SEEN = 1 / 255  # alpha of a ray from which on an MLP is asked what it adds
_RAYS = 1 << 13  # at a time: what they meet stays small


def render_lattice(
    lattice: LatticeField,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
    samples: int = 1,
) -> Image:
    """What the camera sees of the lattice: trilinear values, activated where a sample stands, half a node apart.

    background, transmittance_cut and samples are render_field()'s; so is what a pixel holds. Colours above 1 are cut
    there once a ray's are added up. A deferred colour's MLP is asked once for each ray, of its sums and the background
    behind them. Raises InvalidScene for a lattice that cannot be shown; MemoryLimit.

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
    if not 0 <= transmittance_cut < 1:
        raise InvalidScene(Problem("transmittance_cut", f"is {transmittance_cut:g}", "0 to 1, without 1"))
    nodes, looked = nodes_of(lattice), features_of(lattice)
    return supersampled(
        lambda part: _rendered(lattice, nodes, looked, part, background, transmittance_cut), camera, samples
    )


def _rendered(
    lattice: LatticeField,
    nodes: Nodes,
    looked: Looked,
    camera: Camera,
    background: tuple[float, float, float] | None,
    cut: float,
) -> Image:
    """With one ray a pixel."""
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
    nodes: Nodes,
    looked: Looked,
    origin: Floats,
    looks: Floats,
    cut: float,
    background: tuple[float, float, float] | None,
) -> Floats:
    """(m, 5) of rays: colour weighted by opacity, alpha, and the sum of opacity times distance."""
    ways = looks / (lattice.box[1] - lattice.box[0])
    met = samples_of(nodes, places_of(lattice, origin), ways, lattice.step, cut)
    k = len(met.weights)
    memory.require("what the rays meet", k * (4 * lattice.features.shape[1] + 40))
    ray = np.repeat(np.arange(len(looks)), np.diff(met.first))
    features = looked(met.places)
    if isinstance(lattice.colour, DeferredColour):
        return np.column_stack([_deferred(lattice.colour, met, features, looks, background), met.lost])
    colours = gathered(met, seen_along(lattice, looks)(features, ray))
    return np.column_stack([colours, met.lost])


def _deferred(
    colour: DeferredColour,
    met: Samples,
    features: Singles,
    looks: Floats,
    background: tuple[float, float, float] | None,
) -> Floats:
    """(m, 3) the colour of rays with what the MLP adds to it, without what is behind."""
    sums = summed(met, bare(colour, features))
    behind = (1 - met.lost[:, :1]) * np.array(background or (0, 0, 0))
    sums[:, :3] += behind
    shown = seen_of(colour, looks)(sums, np.arange(len(looks)))
    return np.asarray(np.where(met.lost[:, :1] >= _SEEN, shown, sums[:, :3]) - behind, np.float64)
