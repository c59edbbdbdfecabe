"""Radiance field and camera -> picture: the reference that every bake is judged by."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.affine import placed
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.octree import Lookup
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.stages._supersampled import supersampled

_RAYS = 1 << 17  # at a time, so that a large picture can say how much of it is done
_RAY_BYTES, _BASIS_BYTES = 130, 5  # a pixel, and a pixel and coefficient, while rays are marched (129 and 4.8 measured)


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
    """What the camera sees of the field. Source: docs/conventions.md, "How a picture is made".

    Emission and absorption along the ray through each pixel's centre, front to back over a background (sRGB in 0..1;
    None: transparent). A ray ends where it lets less than transmittance_cut through, and at its stop: (H, W) distances
    from the camera in world units, infinite where nothing stands in the way.

    lookup  nearest: each leaf is a cell of constant density and of the colour that it has in the ray's direction;
            sums along the ray are exact. trilinear: between the centres of cells of the finest level, density and
            coefficients are interpolated, the coefficients by density.
    samples samples x samples rays a pixel (1 to 8), through the middles of as many squares, and their mean: of colours
            as they are, in sRGB, and of depths by alpha. A stop is one ray's: it goes with one ray a pixel alone.

    build_field() makes the field of a scene, once for all pictures; a scene itself is refused with UsageError.

    >>> from nerfbake import build_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> image = render_field(field, orbit_cameras(field, width=16, height=12).cameras[0])
    >>> image.size, bool(image.alpha.max() > 0.5)
    ((16, 12), True)
    """
    require_field(field)
    if not 0 <= transmittance_cut < 1:
        raise InvalidScene(Problem("transmittance_cut", f"is {transmittance_cut:g}", "0 to 1, without 1"))
    if lookup not in ("nearest", "trilinear"):
        raise InvalidScene(Problem("lookup", f"is {lookup!r}", "nearest, trilinear"))
    if stop is not None and stop.shape != (camera.height, camera.width):
        raise InvalidScene(Problem("stop", f"has shape {stop.shape}", f"{(camera.height, camera.width)}"))
    if stop is not None and samples != 1:
        found = f"has a distance a pixel, for {samples!r:.40} samples"
        raise InvalidScene(Problem("stop", found, "1 sample; render_field_and_meshes() for more"))
    return supersampled(
        lambda part: _rendered(field, part, background, transmittance_cut, lookup, stop), camera, samples
    )


def _rendered(
    field: RadianceField,
    camera: Camera,
    background: tuple[float, float, float] | None,
    cut: float,
    lookup: Lookup,
    stop: npt.NDArray[np.float64] | None,
) -> Image:
    """With one ray a pixel."""
    shape = (camera.height, camera.width)
    camera.require_memory(_RAY_BYTES + _BASIS_BYTES * field.basis.size)
    far_away = np.full(camera.height * camera.width, np.inf) if stop is None else stop.astype(np.float64).reshape(-1)
    out = _marched(field, camera, far_away, cut, lookup)
    colour, alpha, far = out[:, :3], out[:, 3], out[:, 4]
    if background is not None:
        colour = colour + (1 - alpha[:, None]) * np.array(background, np.float32)
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    return Image(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), background)


def _marched(
    field: RadianceField, camera: Camera, stop: npt.NDArray[np.float64], cut: float, lookup: Lookup
) -> npt.NDArray[np.float32]:
    from nerfbake.kernels.march.looks import faced

    origin, looks = camera.rays()
    place = placed(origin, field.place)
    # SH are in the field's own axes.
    ways, basis = faced(looks, np.ascontiguousarray(field.place[:, :3]), field.axes, field.basis.size)
    if field.basis.kind == "RGBA":
        basis[:] = 1
    out = np.empty((len(looks), 5), np.float32)
    if lookup == "nearest":
        from nerfbake.kernels.march.traversal import march

        box = field.box
    else:
        from nerfbake.kernels.march.traversal_smooth import march_smooth as march

        # Positions from centre to centre; what is occupied reaches one further on each side.
        place, box = place - 0.5, field.box + np.array([[-1], [0]])
    # A whole number would be another type, for which all of it would be compiled anew.
    for first in progress.each(range(0, len(looks), _RAYS)):
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
            float(cut),
            out[some],
        )
    return out
