"""Radiance field and camera -> picture. This is the reference renderer that every bake is compared with."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
import numpy.typing as npt

from nerfbake import progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.affine import transform_points
from nerfbake.scene.camera import Camera, require_cut, require_samples
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.octree import Lookup
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.stages._supersampled import supersampled

_RAYS = 1 << 17  # rays at a time, so that progress is reported during a large picture
_RAY_BYTES, _BASIS_BYTES = 130, 5  # per pixel, and per pixel and coefficient, during the march (129 and 4.8 measured)


class RenderOptions(TypedDict, total=False):
    """Options of render_field() for callers that pass them on."""

    background: tuple[float, float, float] | None
    transmittance_cut: float
    lookup: Lookup


def render_field(
    field: RadianceField,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
    lookup: Lookup = "nearest",
    stop: npt.NDArray[np.float64] | None = None,
    samples: int = 1,
) -> Image:
    """Render the field as seen by a camera. Source: docs/conventions.md, "How a picture is made".

    Integrates emission and absorption along the ray through each pixel's centre, front to back over a background.

    background         sRGB in 0..1; None: transparent
    transmittance_cut  a ray ends where its transmittance falls below this value
    lookup             nearest: each leaf is a cell with constant density and with its colour in the ray's direction;
                       the integral along the ray is exact. trilinear: density and coefficients are interpolated
                       between the centres of cells of the finest level, the coefficients weighted by density
    stop               (H, W) distances from the camera, in world units, at which rays end; infinite for no end.
                       Requires samples=1, because a distance belongs to one ray
    samples            samples x samples rays per pixel (1 to 8), through the centres of equal squares. Colours are
                       averaged in sRGB, and depths are averaged with alpha as weight

    Build the field of a scene once with build_field(), and use it for all pictures. Raises UsageError for a scene that
    is not a field.

    >>> from nerfbake import build_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> image = render_field(field, orbit_cameras(field, width=16, height=12).cameras[0])
    >>> image.size, bool(image.alpha.max() > 0.5)
    ((16, 12), True)
    """
    require_options(field, camera, transmittance_cut, lookup, stop, samples)
    return supersampled(
        lambda part: _rendered(field, part, background, transmittance_cut, lookup, stop), camera, samples
    )


def require_options(
    field: RadianceField,
    camera: Camera,
    transmittance_cut: float,
    lookup: Lookup,
    stop: npt.NDArray[np.float64] | None,
    samples: int,
) -> None:
    """Raise UsageError or InvalidScene for options that render_field() does not have."""
    require_field(field)
    require_cut(transmittance_cut)
    if lookup not in ("nearest", "trilinear"):
        raise InvalidScene(Problem("lookup", f"is {lookup!r}", "nearest, trilinear"))
    require_samples(samples)
    if stop is not None and stop.shape != (camera.height, camera.width):
        raise InvalidScene(Problem("stop", f"has shape {stop.shape}", f"{(camera.height, camera.width)}"))
    if stop is not None and samples != 1:
        found = f"has one distance per pixel for {samples!r:.40} samples"
        raise InvalidScene(Problem("stop", found, "1 sample; render_field_and_meshes() for more"))


def _rendered(
    field: RadianceField,
    camera: Camera,
    background: tuple[float, float, float] | None,
    cut: float,
    lookup: Lookup,
    stop: npt.NDArray[np.float64] | None,
) -> Image:
    """Render with one ray per pixel."""
    shape = (camera.height, camera.width)
    camera.require_memory(_RAY_BYTES + _BASIS_BYTES * field.basis.size)
    far_away = np.full(camera.height * camera.width, np.inf) if stop is None else stop.astype(np.float64).reshape(-1)
    out = _marched(field, camera, far_away, cut, lookup)
    colour, alpha, far = out[:, :3], out[:, 3], out[:, 4]
    if background is not None:
        premultiplied, clear, colour = colour, 1 - alpha, np.empty((len(out), 3), np.float32)
        for channel, behind in enumerate(np.array(background, np.float32)):  # faster than all three at once
            colour[:, channel] = premultiplied[:, channel] + clear * behind
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    return Image(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), background)


def _marched(
    field: RadianceField, camera: Camera, stop: npt.NDArray[np.float64], cut: float, lookup: Lookup
) -> npt.NDArray[np.float32]:
    from nerfbake.kernels.march.directions import look_and_project, rotate_and_project

    place = transform_points(camera.pose[:3, 3], field.place)
    # SH are in the field's own axes.
    turn, B = np.ascontiguousarray(field.place[:, :3]), field.basis.size
    if (slopes := camera.slopes()) is not None:
        ways, basis = look_and_project(*slopes, camera.pose[:3, :3], turn, field.axes, B)
    else:
        ways, basis = rotate_and_project(camera.rays()[1], turn, field.axes, B)
    if field.basis.kind == "RGBA":
        basis[:] = 1
    out = np.empty((len(ways), 5), np.float32)
    if lookup == "nearest":
        from nerfbake.kernels.march.traversal import march

        box = field.box
    else:
        from nerfbake.kernels.march.traversal_smooth import march_smooth as march

        # Positions are relative to cell centres. Interpolation extends the box to the next centre on each side.
        place, box = place - 0.5, field.box + np.array([[-1], [0]])
    for first in progress.each(range(0, len(ways), _RAYS)):
        some = slice(first, first + _RAYS)
        march(
            field.cells,
            field.values,
            field.densities,
            box,
            place,
            ways[some],
            stop[some],
            basis[some],
            float(cut),  # an integer would be another type, for which numba would compile the kernel again
            out[some],
        )
    return out
