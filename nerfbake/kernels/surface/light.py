"""Light from an environment map on surfaces: irradiance, and maps filtered by the lobe of a rough reflection.

Filtered maps are octahedral with a gutter (octahedron.py), so that lookups need no angles. A filtered texel is a mean
of all texels of the map, weighted by their solid angle and by the lobe, so that a constant map stays constant.

    diffuse   weight n.l, times pi: the irradiance
    specular  weight D(n.h) n.l with n = v = r, the reflected direction: the first half of the split sum
    D = a^2 / (pi ((n.h)^2 (a^2 - 1) + 1)^2), a = roughness^2

Filtered maps assume that a lobe looks alike from all sides (n = v = r). highlights() does not: it sums the whole BRDF
over the map.

Source: Karis, "Real shading in Unreal Engine 4" (2013); glTF 2.0, appendix B.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.kernels.jit import compiled, part_of
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.surface.octahedron import texel_directions, uv_of, with_gutter

DIFFUSE = 0.0  # in place of a roughness
_SAMPLES = 512  # of the table of reflectances: within 0.003 of 65536
_VIEWS = 64


class Sources(NamedTuple):
    """The texels of a map: directions (s, 3), solid angles times radiance (s, 3), solid angles (s,)."""

    directions: Floats
    light: Floats
    angles: Floats


def sources(radiance: Singles, rows: int) -> Sources:
    """The light of a map (H, 2 H, 3), averaged to at most `rows` rows."""
    wide = radiance.astype(np.float64)
    while len(wide) > rows:
        if len(wide) % 2:
            wide = np.concatenate([wide, wide[-1:]])
        if wide.shape[1] % 2:
            wide = np.concatenate([wide, wide[:, -1:]], axis=1)
        wide = (wide[::2, ::2] + wide[1::2, ::2] + wide[::2, 1::2] + wide[1::2, 1::2]) / 4
    H, W, _ = wide.shape
    (sine, cosine), (east, north) = _angles(np.pi / H, H), _angles(2 * np.pi / W, W)
    # The middle of a row is +x, where the angle from its left edge is pi; a quarter before it is +y.
    x, y = np.outer(sine, -north), np.outer(sine, east)
    directions = np.stack([x, y, np.broadcast_to(cosine[:, None], x.shape)], axis=-1)
    angles = np.broadcast_to((sine * (2 * np.pi * np.pi / (H * W)))[:, None], x.shape)
    light = wide * angles[..., None]
    return Sources(*(np.ascontiguousarray(each.reshape(-1, *each.shape[2:])) for each in (directions, light, angles)))


def _angles(step: float, count: int) -> tuple[Floats, Floats]:
    return sine_cosine((np.arange(count) + 0.5) * step)


def filtered(light: Sources, roughness: float, edge: int) -> Singles:
    """(edge + 2, edge + 2, 3): the map seen in each direction through a lobe; DIFFUSE: the irradiance."""
    found = np.empty((edge * edge, 3), np.float32)
    _filter(*light, texel_directions(edge), float(roughness) ** 4, found)
    return np.asarray(with_gutter(found.reshape(1, edge, edge, 3), 1)[0])


@on_every_core
@compiled()
def _filter(
    core: int,
    cores: int,
    directions: Floats,
    light: Floats,
    angles: Floats,
    towards: Floats,
    squared: float,
    out: Singles,
) -> None:
    begin, end = part_of(len(towards), core, cores)
    for i in range(begin, end):
        r, g, b, total = 0.0, 0.0, 0.0, 0.0
        for s in range(len(directions)):
            cosine = (
                towards[i, 0] * directions[s, 0] + towards[i, 1] * directions[s, 1] + towards[i, 2] * directions[s, 2]
            )
            if cosine <= 0:
                continue
            weight = cosine
            if squared > 0:
                # (n.h)^2 = (1 + n.l) / 2; constant factors of D cancel.
                spread = (1 + cosine) / 2 * (squared - 1) + 1
                weight /= spread * spread
            r, g, b = r + weight * light[s, 0], g + weight * light[s, 1], b + weight * light[s, 2]
            total += weight * angles[s]
        scale = (1.0 if squared > 0 else np.pi) / total
        out[i, 0], out[i, 1], out[i, 2] = scale * r, scale * g, scale * b


def highlights(light: Sources, normals: Singles, toward: Singles, roughness: float) -> Singles:
    """(p, 3): the light that a surface of F0 0.04 and F90 1 reflects, without the split sum.

    normals, toward (p, 3): unit vectors of the surface and to the camera. A wide lobe needs few texels of a map.
    """
    found = np.empty((len(normals), 3), np.float32)
    squared = float(roughness) * roughness
    _reflect(light.directions, light.light, normals, toward, squared * squared, found)
    return found


@on_every_core
@compiled()
def _reflect(
    core: int,
    cores: int,
    directions: Floats,
    light: Floats,
    normals: Singles,
    toward: Singles,
    squared: float,
    out: Singles,
) -> None:
    begin, end = part_of(len(normals), core, cores)
    for i in range(begin, end):
        nx, ny, nz = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        vx, vy, vz = float(toward[i, 0]), float(toward[i, 1]), float(toward[i, 2])
        nv = max(nx * vx + ny * vy + nz * vz, 1e-4)
        seen = np.sqrt(nv * nv * (1 - squared) + squared)
        r, g, b = 0.0, 0.0, 0.0
        for s in range(len(directions)):
            x, y, z = directions[s, 0], directions[s, 1], directions[s, 2]
            nl = nx * x + ny * y + nz * z
            if nl <= 0:
                continue
            # Of the half vector: |l + v| = 2 v.h.
            vh = np.sqrt(max(2 + 2 * (vx * x + vy * y + vz * z), 1e-9)) / 2
            nh = (nl + nv) / (2 * vh)
            spread = nh * nh * (squared - 1) + 1
            smith = nl * seen + nv * np.sqrt(nl * nl * (1 - squared) + squared)
            far = 1 - vh
            fresnel = 0.04 + 0.96 * (far * far * far * far * far)
            weight = squared * fresnel * nl / (2 * np.pi * spread * spread * smith)
            r, g, b = r + weight * light[s, 0], g + weight * light[s, 1], b + weight * light[s, 2]
        out[i, 0], out[i, 1], out[i, 2] = r, g, b


def looked_up(framed: Singles, directions: Singles) -> Singles:
    """(p, 3): a filtered map in unit directions (p, 3), bilinear."""
    edge = len(framed) - 2
    place = uv_of(directions) * edge + 0.5  # in texel centres of the frame
    corner = np.minimum(place.astype(np.int64), edge)
    fx, fy = (place - corner).astype(np.float32).T[..., None]
    x, y = corner.T
    top = framed[y, x] * (1 - fx) + framed[y, x + 1] * fx
    low = framed[y + 1, x] * (1 - fx) + framed[y + 1, x + 1] * fx
    return np.asarray(top * (1 - fy) + low * fy, np.float32)


def reflectances(roughness: float) -> Singles:
    """(64,): the share of constant light that a surface of F0 0.04, F90 1 reflects, for n.v = 0, 1/63, ... 1.

    The second half of the split sum, with the height-correlated Smith term of glTF's appendix B.
    """
    squared = float(roughness) ** 4
    v = np.maximum(np.linspace(0, 1, _VIEWS), 1e-3)[:, None]
    first = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    _, cosine = sine_cosine(np.pi * (2 * _radical(_SAMPLES) - 1))
    nh = np.sqrt((1 - first) / (1 + (squared - 1) * first))
    across = np.sqrt(1 - nh * nh)
    vh = np.maximum(np.sqrt(1 - v * v) * (across * cosine) + v * nh, 0)
    nl = 2 * vh * nh - v
    lit = np.maximum(nl, 1e-9)
    smith = lit * np.sqrt(v * v * (1 - squared) + squared) + v * np.sqrt(lit * lit * (1 - squared) + squared)
    far = 1 - np.minimum(vh, 1)
    fresnel = 0.04 + 0.96 * (far * far * far * far * far)
    share = np.where(nl > 0, 2 / smith * lit * vh / nh * fresnel, 0)
    return np.asarray(share.sum(axis=1) / _SAMPLES, np.float32)


def _radical(count: int) -> Floats:
    """The van der Corput sequence: the bits of 0, 1, 2, ... mirrored at the point."""
    number, found, share = np.arange(count), np.zeros(count), 0.5
    while share * count >= 0.5:
        found += (number & 1) * share
        number, share = number >> 1, share / 2
    return found


@compiled()
def interpolate(places: Singles, faces: npt.NDArray[np.uint32], values: Singles, out: Singles, known: Bits) -> None:
    """Fill the texels of (H, W, C) whose centre is in a triangle from the values (v, C) of its vertices.

    places (v, 2) of the vertices in texel centres.
    """
    H, W, C = out.shape
    for f in range(len(faces)):
        a, b, c = places[faces[f, 0]], places[faces[f, 1]], places[faces[f, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        left, right = int(np.ceil(min(a[0], b[0], c[0]))), int(np.floor(max(a[0], b[0], c[0])))
        top, bottom = int(np.ceil(min(a[1], b[1], c[1]))), int(np.floor(max(a[1], b[1], c[1])))
        for y in range(max(top, 0), min(bottom, H - 1) + 1):
            for x in range(max(left, 0), min(right, W - 1) + 1):
                u = ((c[0] - b[0]) * (y - b[1]) - (c[1] - b[1]) * (x - b[0])) / area
                v = ((a[0] - c[0]) * (y - c[1]) - (a[1] - c[1]) * (x - c[0])) / area
                w = 1 - u - v
                if u >= 0 and v >= 0 and w >= 0:
                    known[y, x] = True
                    for k in range(C):
                        out[y, x, k] = (
                            u * values[faces[f, 0], k] + v * values[faces[f, 1], k] + w * values[faces[f, 2], k]
                        )
