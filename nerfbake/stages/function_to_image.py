"""Trained function and camera -> picture, without a bake: the reference for bakes of the function."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.kernels.arrays import Floats, Indices, Points, Singles
from nerfbake.kernels.maths.affine import rotate, transform_points
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import Camera, Cameras, require_cut
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages._supersampled import supersampled
from nerfbake.stages.field_to_image import render_field

if TYPE_CHECKING:
    from nerfbake.kernels.network.samples import RayWalk

# Steps along an edge of the box or, of a contracted field, of the inner cube. Pictures of a nerfacto with 512, 1,024
# and 2,048 differ from those with 4,096 by 56, 69 and 80 dB.
STEPS = 1024
# Trained units: where rays through contracted space end. Programs take one sample of all that is farther away, where
# the density counts a thousandfold. Against nerfstudio's own pictures, four views of a nerfacto have 48.6, 51.2, 46.2
# and 38.6 dB with this end, and 38.1, 42.2, 35.6 and 32.1 dB if rays go on to the program's `far`, 1,000.
FARTHEST = 64.0
_TOGETHER = 16  # samples of a ray that are evaluated at a time
_RAYS = 1 << 12  # rays at a time
_LEAST = 1e-5  # weight of a sample whose colour is computed
_LAST = 1 - 1 / STEPS  # of the way, where the last sample is
_RAY_BYTES, _SAMPLE_BYTES = 260, 200


def render_function(
    field: FunctionField,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
    samples: int = 1,
) -> Image:
    """Render the function itself as seen by a camera.

    Samples are a 1,024th of the box apart, or of a contracted field's inner cube, and farther apart outside of that
    cube: as far as contraction brings them together. Rays begin at the field's `near`, and pass over the cells that
    `field.filled` leaves out. They end where they leave the box or, of a contracted field, at `far`, and at 64 trained
    units at the latest.

    If the field's background is the colour of the last sample, that colour is behind every ray, whatever `background`
    is, and the picture is opaque. For background, transmittance_cut and samples, see render_field(). Raises
    InvalidScene for a field that cannot be rendered; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import FunctionField, orbit_cameras, render_function
    >>> from nerfbake.scene.lattice_field import Activation
    >>> from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network
    >>> fog = Mlp((np.zeros((1, 3), np.float32),), (np.full(1, 9, np.float32),))
    >>> grey = HeadColour(Mlp((np.zeros((3, 1), np.float32),), (np.zeros(3, np.float32),)), "none")
    >>> network = Network(Frequencies(np.zeros(0)), fog, np.ones(1, np.float32), 0.0, Activation("relu"), grey)
    >>> field = FunctionField(network, np.eye(3, 4), np.array([[-1.0] * 3, [1.0] * 3]))
    >>> image = render_function(field, orbit_cameras(field, width=9, height=9).cameras[0])
    >>> image.colour[4, 4].round(3).tolist(), image.colour[0, 0].tolist()
    ([0.5, 0.5, 0.5], [1.0, 1.0, 1.0])
    """
    field.require_usable()
    require_cut(transmittance_cut)
    return supersampled(lambda part: _rendered(field, part, background, transmittance_cut, None)[0], camera, samples)


class FunctionLoss(NamedTuple):
    """How a bake differs from its function.

    psnr     mean over the views, in dB
    outside  share of the pictures' pixels that shows what is outside of the baked box
    """

    psnr: float
    outside: float


def measure_function(field: FunctionField, made: RadianceField, cameras: Cameras, box: Points) -> FunctionLoss:
    """Compare pictures of a function with those of its bake, over white. box (2, 3): what was baked, in the world.

    Raises InvalidScene for fields that cannot be rendered; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import FunctionField, bake_function, build_field, measure_function, scatter_cameras
    >>> from nerfbake.scene.lattice_field import Activation
    >>> from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network
    >>> fog = Mlp((np.zeros((1, 3), np.float32),), (np.full(1, 9, np.float32),))
    >>> grey = HeadColour(Mlp((np.zeros((3, 1), np.float32),), (np.zeros(3, np.float32),)), "none")
    >>> network = Network(Frequencies(np.zeros(0)), fog, np.ones(1, np.float32), 0.0, Activation("relu"), grey)
    >>> field = FunctionField(network, np.eye(3, 4), np.array([[-1.0] * 3, [1.0] * 3]))
    >>> made = build_field(bake_function(field, resolution=8, basis="SH1"))
    >>> loss = measure_function(field, made, scatter_cameras(field, frames=2, edge=16), made.world(made.box))
    >>> loss.psnr > 25, loss.outside
    (True, 0.0)
    """
    field.require_usable()
    found, shares = [], []
    for camera in progress.each(cameras.cameras):
        truth, outside = _rendered(field, camera, WHITE, 1e-4, box)
        image = render_field(made, camera)
        found.append(psnr(truth.colour.astype(np.float64), image.colour.astype(np.float64)))
        shares.append(outside)
    return FunctionLoss(sum(found) / len(found), sum(shares) / len(shares))


def look_beyond(field: FunctionField, eye: Floats, looks: Points, distance: Floats) -> tuple[Floats, Floats]:
    """Return what rays from a world point see that begin at these distances (m,): colours times alpha, and alpha."""
    out = np.empty((len(looks), 5))
    for begin in progress.each(range(0, len(looks), _RAYS)):
        some = slice(begin, begin + _RAYS)
        out[some] = _along(field, eye, looks[some], 1e-4, None, distance[some] * field.scale)[0]
    return out[:, :3], out[:, 3]


def _rendered(
    field: FunctionField,
    camera: Camera,
    background: tuple[float, float, float] | None,
    cut: float,
    box: Points | None,
) -> tuple[Image, float]:
    """Render with one ray per pixel. Also returns the mean weight of the samples outside of a box, of None 0."""
    camera.require_memory(_RAY_BYTES)
    eye, looks = camera.rays()
    out, outside = np.empty((len(looks), 5)), 0.0
    with progress.part(0, 0.1):
        assert field.filled.size
    with progress.part(0.1, 1):
        for begin in progress.each(range(0, len(looks), _RAYS)):
            found, beyond = _along(field, eye, looks[begin : begin + _RAYS], cut, box)
            out[begin : begin + len(found)] = found
            outside += beyond
    shape = (camera.height, camera.width)
    colour, alpha, far = out[:, :3].astype(np.float32), out[:, 3].astype(np.float32), out[:, 4].astype(np.float32)
    if background is not None:
        colour = colour + (1 - alpha[:, None]) * np.array(background, np.float32)
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    image = Image(np.minimum(colour, 1).reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), background)
    return image, outside / len(looks)


def _along(
    field: FunctionField, eye: Floats, looks: Points, cut: float, box: Points | None, start: Floats | float = 0.0
) -> tuple[Floats, float]:
    """Return for each ray (m, 5): colour weighted by opacity, alpha, and the sum of opacity times distance.

    Also returns the sum of the weights outside of a box. start: where rays begin at least, in trained units.
    """
    from nerfbake.kernels.network.samples import absorb, next_samples

    walk, m = _walk(field, eye, looks, start), len(looks)
    out, left, sums, outside = np.zeros((m, 5)), np.ones(m), np.zeros((m, 2)), 0.0
    at, rays = walk.spans[:, 0].copy(), np.flatnonzero(walk.spans[:, 0] < walk.spans[:, 1])
    memory.require("the samples along the rays", m * _TOGETHER * _SAMPLE_BYTES)
    while len(rays):
        counts, steps = next_samples(walk, rays, at, _TOGETHER)
        taken = np.arange(_TOGETHER) < counts[:, None]
        begin, length = steps[taken].T
        own = np.repeat(rays, counts)
        points = eye + ((begin + length / 2) / field.scale)[:, None] * looks[own]
        sigma, features = field.density(points)
        weights = absorb(counts, steps, sigma * (length / field.scale), rays, left, sums)
        shown = np.flatnonzero(weights > _LEAST)
        _add(out, own[shown], weights[shown], field.colour(features[shown], looks[own[shown]]))
        if box is not None:
            outside += float(weights[((points < box[0]) | (points > box[1])).any(axis=1)].sum(dtype=np.float64))
        rays = rays[(left[rays] >= cut) & (at[rays] < walk.spans[rays, 1])]
    out[:, 3], out[:, 4] = sums[:, 0], sums[:, 1] / field.scale
    if field.background == "last":
        end = np.where(np.isfinite(field.far) & field.contracted, field.far, walk.spans[:, 1]) / field.scale
        features = field.density(eye + (end * _LAST)[:, None] * looks)[1]
        _add(out, np.arange(m), left, field.colour(features, looks))
        out[:, 3], out[:, 4] = 1, out[:, 4] + left * end
    return out, outside


def _add(out: Floats, rays: Indices, weights: Floats | Singles, colours: Singles) -> None:
    """Add weighted colours to those of their rays; the terms of a ray are added in order."""
    for channel in range(3):
        out[:, channel] += np.bincount(rays, weights * colours[:, channel].astype(np.float64), len(out))


def _walk(field: FunctionField, eye: Floats, looks: Points, start: Floats | float) -> RayWalk:
    """Return where rays from a world point go, in trained units."""
    from nerfbake.kernels.network.samples import RayWalk

    origin, ways = transform_points(eye, field.frame), rotate(looks, field.frame[:, :3] / field.scale)
    begin = np.maximum(np.full(len(looks), field.near), start)
    end = np.full(len(looks), min(field.far, FARTHEST) if field.contracted else np.inf)
    if field.contracted:
        edge = 2.0
    else:
        edge = float((field.box[1] - field.box[0]).max())
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (field.box[:, None] - origin) / ways
        sides[0][np.isnan(sides[0])], sides[1][np.isnan(sides[1])] = -np.inf, np.inf  # on a side, and parallel to it
        begin = np.maximum(begin, sides.min(axis=0).max(axis=1))
        end = np.minimum(end, sides.max(axis=0).min(axis=1))
    spans = np.stack([begin, np.maximum(begin, end)], axis=1)
    low, size = field.space[0], field.space[1] - field.space[0]
    return RayWalk(origin, ways, spans, edge / STEPS, field.contracted, field.filled, low, size)
