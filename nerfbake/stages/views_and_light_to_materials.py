"""Mesh, photographs and an environment map -> albedo, and roughness and specular strength of clusters of texels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles
from nerfbake.kernels.cluster import lloyd
from nerfbake.kernels.picture.metrics import decibels, from_linear, to_linear
from nerfbake.kernels.surface import light, texels
from nerfbake.kernels.surface.normals import welded_normals
from nerfbake.kernels.surface.raster import covered_texels
from nerfbake.scene.environment import EnvironmentMap
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.views import Views
from nerfbake.stages._texels import Seen, see, texel_places
from nerfbake.stages.surface_to_charts import require_texture
from nerfbake.stages.views_to_texture import DiffuseProblem, first_guess, mean_texels, rounded

CLUSTERS = 8
_ROUGHNESSES = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
_ROWS, _EDGE = 64, 48  # of the map, and of filtered maps: 3 degrees, less than the lobe of the least roughness
# Highlights of at least this roughness are summed over a map of this many rows, without the split sum, which finds a
# strength of 0.5 at roughness 0.6 as 0.36 and 1 at 0.8 as 0.55. The sum finds 0.45 and 0.88.
_SUMMED, _SUMMED_ROWS = 0.4, 16
_PIXELS = 400_000  # from which materials are estimated; more pixels than these are thinned out evenly
_PATCH = 4  # texels along an edge of a patch, which has one albedo while materials are estimated
_ROUNDS = 10  # of k-means
_GRAZING = 0.4  # cosine below which a view is left out: the split sum is wrong there
_CLIPPED = 0.98  # sRGB: brighter pixels are cut off
_DOUBT = 0.05  # linear light: residuals above it count less, as those of shadows and occlusion
_STEPS = 6  # of the albedo's least squares
_PIXEL_BYTES = 160 + 12 * len(_ROUGHNESSES)
_TEXEL_BYTES = 120


class Material(NamedTuple):
    """A cluster of texels.

    share      of the texels, 0 to 1
    roughness  glTF's perceptual roughness; specular: KHR_materials_specular's specularFactor, 0 to 1
    """

    share: float
    roughness: float
    specular: float


class LitMaterials(NamedTuple):
    """The mesh with albedo and material, and its clusters, the largest first."""

    mesh: Mesh
    clusters: tuple[Material, ...]


def fit_materials(
    mesh: Mesh, views: Views, environment: EnvironmentMap, *, edge: int = 2048, samples: int = 2
) -> LitMaterials:
    """Return the mesh with an albedo texture (edge, edge, 3) and a material (edge, edge, 2), both uint8.

    A pixel is albedo / pi times the irradiance of its normal, plus the map filtered by the lobe of the roughness, in
    the reflected direction, times specular strength and the reflectance of F0 0.04 (the split sum of glTF viewers).
    While rough materials are estimated, the whole BRDF is summed over a small map instead. A cluster has one roughness
    and one strength, those with the least squared error over its pixels, where each patch of 4x4 texels has its own
    albedo: the highlight is what changes with the direction. Photographs are sRGB of linear light with the exposure of
    the map. Shadows and light between surfaces are ignored; pixels that do not fit count less.

    Same bytes for any number of threads. Raises InvalidScene if no view shows the mesh or the map is black,
    MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import EnvironmentMap, build_views, fit_materials, orbit_cameras, render_meshes, sample_stage1
    >>> from nerfbake import Meshes
    >>> torus = sample_stage1(resolution=16).meshes[0]
    >>> cameras = orbit_cameras(Meshes((torus,)), frames=3, width=16, height=16)
    >>> pictures = [render_meshes(Meshes((torus,)), each, background=None).pixels for each in cameras.cameras]
    >>> sky = EnvironmentMap(np.ones((4, 8, 3), np.float32))
    >>> fit_materials(torus, build_views(cameras, pictures), sky, edge=32, samples=1).mesh.material.shape
    (32, 32, 2)
    """
    require_texture(edge)
    environment.require_light()
    with memory.scope():
        memory.hold(f"a texture of {edge}x{edge} texels", _TEXEL_BYTES * edge * edge)
        seen = see(mesh, views, edge, samples)
        memory.hold("light of the pixels", 104 * len(seen.cover) + _PIXEL_BYTES * min(len(seen.cover), _PIXELS))
        used = covered_texels(mesh.require_unwrapped(), mesh.faces, edge, edge)
        lit = _Lit(_Light(environment), _normals(mesh, edge), seen)
        labels = _clusters(seen, lit, used)
        roughness, specular = _estimated(seen, lit, labels)
        albedo = _albedo(seen, lit, used, roughness[labels], specular[labels])
        texture = rounded(from_linear(albedo))
        material = np.asarray(np.rint(255 * np.stack([roughness, specular], axis=1)), np.uint8)[labels]
        counts = np.bincount(labels[used], minlength=CLUSTERS)
    order = [int(k) for k in np.argsort(-counts, kind="stable") if counts[k]]
    found = [Material(float(counts[k] / counts.sum()), float(roughness[k]), float(specular[k])) for k in order]
    made = memory.kept(replace(mesh, texture=texture, material=material, colours=None))
    return LitMaterials(made, tuple(found))


def light_pixels(mesh: Mesh, views: Views, environment: EnvironmentMap, *, samples: int = 2) -> tuple[float, ...]:
    """Return the PSNR in dB of the lit mesh on the pixels that it covers, for each view that shows it.

    For a mesh with texture and material, as fit_materials() returns it. Raises InvalidScene if no view shows the mesh.
    """
    texture, material = mesh.texture, mesh.material
    if texture is None or material is None:
        raise InvalidScene(Problem("the mesh", "has no material", "a texture and a material"))
    edge, found = len(texture), list[float]()
    known, normals = _Light(environment), _normals(mesh, edge)
    albedo = to_linear(texture / np.float32(255))
    for number in range(len(views.pictures)):
        one = views.take([number])
        try:
            seen = see(mesh, one, edge, samples)
        except InvalidScene:
            continue
        lit = _Lit(known, normals, seen)
        own = np.asarray(material[lit.place[:, 1], lit.place[:, 0]] / np.float32(255), np.float32)
        shown = _means(seen, albedo) * lit.diffuse
        shown += lit.highlights(own[:, 0]) * own[:, 1:]
        rest = ((from_linear(shown).astype(np.float64) - seen.targets) ** 2).mean(axis=1) * seen.cover
        found.append(decibels(float(np.cumsum(rest)[-1] / np.cumsum(seen.cover, dtype=np.float64)[-1])))
    if not found:
        allowed = "held-out views that show the mesh"
        raise InvalidScene(Problem("the mesh", "is not visible in any held-out view", allowed))
    return tuple(found)


class _Light:
    """The light of a map: its irradiance, its filtered maps and reflectances of _ROUGHNESSES, and a smaller map."""

    def __init__(self, environment: EnvironmentMap) -> None:
        sources = light.sources(environment.radiance, _ROWS)
        self.irradiance = light.filtered(sources, light.DIFFUSE, _EDGE)
        self.maps = [light.filtered(sources, roughness, _EDGE) for roughness in progress.each(_ROUGHNESSES)]
        self.tables = [light.reflectances(roughness) for roughness in _ROUGHNESSES]
        self.few = light.sources(environment.radiance, _SUMMED_ROWS)


class _Lit:
    """The light of pixels: diffuse (p, 3), of albedo 1, and highlights (p, 3), of strength 1.

    texel_normals: of the mesh, as _normals() returns them.
    """

    def __init__(self, known: _Light, texel_normals: Singles, seen: Seen) -> None:
        self._light = known
        normals = _means(seen, texel_normals)
        normals /= np.maximum(np.sqrt((normals * normals).sum(axis=1, keepdims=True)), np.float32(1e-6))
        toward = -(normals * seen.directions).sum(axis=1)
        self.toward = np.clip(toward, 0, 1)
        self._normals, self._toward_camera = normals, -seen.directions
        self._mirrored = seen.directions + 2 * toward[:, None] * normals
        self.diffuse = light.looked_up(known.irradiance, normals) / np.float32(np.pi)
        # The texel of a pixel: that of its first ray.
        self.place = np.rint(seen.lookups.at[seen.lookups.starts[:-1]]).astype(np.int64)

    def level(self, number: int, where: Ints) -> Singles:
        """(w, 3) highlights of one roughness, of some pixels."""
        roughness = _ROUGHNESSES[number]
        if roughness >= _SUMMED:
            return light.highlights(self._light.few, self._normals[where], self._toward_camera[where], roughness)
        return self._highlights(np.full(len(where), roughness), where)

    def highlights(self, roughness: Singles) -> Singles:
        """(p, 3) highlights of a roughness for each pixel."""
        return self._highlights(roughness.astype(np.float64), np.arange(len(roughness)))

    def _highlights(self, roughness: Floats, where: Ints) -> Singles:
        toward = self.toward[where].astype(np.float64)
        # Seen at an angle, a lobe of half vectors becomes a lobe of directions whose solid angle is smaller by n.v: as
        # that of roughness (n.v)^(1/4). Without it, a roughness of 0.6 is found as 0.44, with it as 0.55.
        narrow = roughness * np.sqrt(np.sqrt(np.maximum(toward, 1e-4)))
        towards, tables = self._mirrored[where], self._light.tables
        light_, share = np.zeros((len(where), 3), np.float32), np.zeros(len(where), np.float32)
        at = toward * (len(tables[0]) - 1)
        for number, pixels, part in _between(narrow):
            light_[pixels] += part[:, None] * light.looked_up(self._light.maps[number], towards[pixels])
        for number, pixels, part in _between(roughness):
            table, low = tables[number], np.minimum(at[pixels].astype(np.int64), len(tables[0]) - 2)
            share[pixels] += part * (table[low] + (at[pixels] - low) * (table[low + 1] - table[low]))
        return light_ * share[:, None]


def _between(roughness: Floats) -> Iterator[tuple[int, Ints, Singles]]:
    """Yield each level with the pixels whose roughness is near it, and their shares, which add to 1."""
    levels = np.array(_ROUGHNESSES)
    low = np.clip(np.searchsorted(levels, roughness, side="right") - 1, 0, len(levels) - 2)
    part = np.clip((roughness - levels[low]) / (levels[low + 1] - levels[low]), 0, 1).astype(np.float32)
    for number in range(len(levels)):
        for step, share in ((0, 1 - part), (1, part)):
            pixels = np.flatnonzero((low + step == number) & (share > 0))
            if len(pixels):
                yield number, pixels, share[pixels]


def _normals(mesh: Mesh, edge: int) -> Singles:
    """(edge, edge, 3) the smooth normals of texels, continued beyond the charts."""
    out, known = np.zeros((edge, edge, 3), np.float32), np.zeros((edge, edge), np.bool_)
    light.interpolate(texel_places(mesh, edge), mesh.faces, welded_normals(mesh.positions, mesh.faces), out, known)
    return texels.fill(out, known)


def _means(seen: Seen, values: Singles) -> Singles:
    """(p, 3) the mean of the lookups of each pixel in (edge, edge, 3)."""
    out = np.empty_like(seen.targets)
    texels.residuals(*seen.lookups, np.ascontiguousarray(values, np.float32), np.zeros_like(out), out)
    return -out


def _clusters(seen: Seen, lit: _Lit, used: Bits) -> Ints:
    """(edge, edge) 0 to CLUSTERS - 1, by the mean colour of the texel in all views, divided by its irradiance.

    Without the division, clusters are lit and dark sides instead of materials.
    """
    plain = from_linear(to_linear(seen.targets) / np.maximum(lit.diffuse, np.float32(1e-3)))
    colours = mean_texels(seen, seen.cover * seen.cover * np.maximum(lit.toward, np.float32(0.01)), plain, used)
    points = np.ascontiguousarray(colours.reshape(-1, 3))
    chosen = np.flatnonzero(used.reshape(-1))
    some = points[chosen[:: max(1, len(chosen) // 50_000)]]
    weight, cells = np.ones(len(some)), lloyd.bound_cells(some, np.array([0, len(some)], np.int64))
    centres = lloyd.seed(some, weight, CLUSTERS, np.random.default_rng(0))
    for _ in range(_ROUNDS):
        centres = lloyd.move(some, weight, lloyd.nearest_centres(some, cells, centres)[0], centres)
    cells = lloyd.bound_cells(points, np.array([0, len(points)], np.int64))
    return lloyd.nearest_centres(points, cells, centres)[0].astype(np.int64).reshape(used.shape)


def _estimated(seen: Seen, lit: _Lit, labels: Ints) -> tuple[Singles, Singles]:
    """(K,) roughness and specular strength of the clusters; a cluster without any highlight has 1 and 0."""
    sound = (lit.toward > _GRAZING) & (seen.targets.max(axis=1) < _CLIPPED) & (seen.cover > 0.5)
    where = np.flatnonzero(sound)
    where = where[:: -(-max(len(where), 1) // _PIXELS)]
    if not len(where):
        return np.ones(CLUSTERS, np.float32), np.zeros(CLUSTERS, np.float32)
    x, y = lit.place[where].T
    cluster = labels[y, x]
    wide = -(-len(labels) // _PATCH)
    # Patches that two clusters share are two patches, so that each has the strength of one cluster.
    key = (y // _PATCH * wide + x // _PATCH) * CLUSTERS + cluster
    _, patch = np.unique(key, return_inverse=True)
    problem = _PatchProblem(to_linear(seen.targets[where]), lit.diffuse[where], patch.reshape(-1), cluster)
    levels = [lit.level(number, where) for number in range(len(_ROUGHNESSES))]
    weights = np.ones(len(where))
    for turn in range(2):
        errors, strengths = zip(*(problem.solved(level, weights) for level in levels), strict=True)
        error, strength = np.array(errors), np.array(strengths)
        best = error.argmin(axis=0)
        if not turn:
            chosen = np.stack(levels)[best[cluster], np.arange(len(where))]
            rest = problem.rest(chosen, strength[best, np.arange(CLUSTERS)][cluster], weights)
            weights = np.minimum(1, _DOUBT / np.maximum(rest, _DOUBT))
    roughness, specular = np.ones(CLUSTERS, np.float32), np.zeros(CLUSTERS, np.float32)
    for k in range(CLUSTERS):
        found = _least(np.array(_ROUGHNESSES), error[:, k])
        power = float(np.interp(found, _ROUGHNESSES, strength[:, k]))
        if power > 0:
            roughness[k], specular[k] = found, power
    return roughness, specular


class _PatchProblem:
    """Pixels = albedo of their patch x diffuse + strength of their cluster x highlight, by least squares.

    The best albedo for any strength is known in closed form (variable projection): it leaves one unknown a cluster.
    """

    def __init__(self, targets: Singles, diffuse: Singles, patch: Ints, cluster: Ints) -> None:
        self._targets, self._diffuse = targets.astype(np.float64), diffuse.astype(np.float64)
        self._patch, self._cluster = patch, cluster

    def _without_albedo(self, values: Floats, weights: Floats) -> Floats:
        """(p, 3) what no albedo explains."""
        out = np.empty_like(values)
        for c in range(3):
            x = self._diffuse[:, c]
            top = np.bincount(self._patch, weights * x * values[:, c])
            low = np.bincount(self._patch, weights * x * x)
            out[:, c] = values[:, c] - (top / np.maximum(low, 1e-12))[self._patch] * x
        return out

    def solved(self, highlight: Singles, weights: Floats) -> tuple[Floats, Floats]:
        """(K,) squared errors, and strengths in 0..1."""
        t, y = (self._without_albedo(each.astype(np.float64), weights) for each in (self._targets, highlight))

        def total(values: Floats) -> Floats:
            return np.asarray(np.bincount(self._cluster, weights * values.sum(axis=1), CLUSTERS), np.float64)

        tt, ty, yy = total(t * t), total(t * y), total(y * y)
        strength = np.clip(ty / np.maximum(yy, 1e-12), 0, 1)
        return tt - 2 * strength * ty + strength * strength * yy, strength

    def rest(self, highlight: Singles, strength: Floats, weights: Floats) -> Floats:
        """(p,) lengths of the residuals."""
        left = self._without_albedo(self._targets - strength[:, None] * highlight, weights)
        return np.asarray(np.sqrt((left * left).sum(axis=1)))


def _least(levels: Floats, errors: Floats) -> float:
    """Where the parabola through the least error and its neighbours is least."""
    at = int(errors.argmin())
    if at in (0, len(levels) - 1):
        return float(levels[at])
    (a, b, c), (fa, fb, fc) = levels[at - 1 : at + 2], errors[at - 1 : at + 2]
    low = (b - a) * (fb - fc) - (b - c) * (fb - fa)
    if low == 0:
        return float(b)
    return float(np.clip(b - ((b - a) ** 2 * (fb - fc) - (b - c) ** 2 * (fb - fa)) / (2 * low), a, c))


def _albedo(seen: Seen, lit: _Lit, used: Bits, roughness: Singles, specular: Singles) -> Singles:
    """(edge, edge, 3) linear albedo, from what the highlights leave."""
    x, y = lit.place.T
    left = to_linear(seen.targets) - specular[y, x][:, None] * lit.highlights(roughness[y, x])
    dark = lit.diffuse.mean(axis=1)
    targets = np.clip(left / np.maximum(lit.diffuse, np.float32(1e-3)), 0, 1).astype(np.float32)
    bright = max(float(dark.max()), 1e-6)
    facing = np.where(lit.toward > _GRAZING, 1, 0.01) * np.where(seen.targets.max(axis=1) < _CLIPPED, 1, 0.1)
    weights = (seen.cover * seen.cover * (dark / bright) ** 2 * facing).astype(np.float32)
    found, rest = first_guess(seen, weights, targets, used)
    return texels.fill(DiffuseProblem(seen, weights, used).improved(found, rest, _STEPS), used)
