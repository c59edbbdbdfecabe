"""Materials under a known light, against pictures that a float64 integral of the whole BRDF has made."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from nerfbake import Camera, Cameras, EnvironmentMap, Mesh, Views, fit_materials
from nerfbake.errors import InvalidScene
from nerfbake.scene.camera import look_at
from nerfbake.stages.views_and_light_to_materials import light_pixels

pytestmark = pytest.mark.slow
EDGE = 64
ALBEDO = np.array([(0.5, 0.15, 0.1), (0.08, 0.25, 0.5)])
ROUGHNESS, SPECULAR = np.array([0.25, 0.6]), np.array([1.0, 0.5])


def ball(rows: int = 24, columns: int = 48) -> Mesh:
    """A unit sphere of longitudes and latitudes, unfolded as a rectangle."""
    v, u = (
        each.reshape(-1) for each in np.meshgrid(*(np.linspace(0, 1, n + 1) for n in (rows, columns)), indexing="ij")
    )
    theta, phi = np.pi * v, 2 * np.pi * u
    places = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    a, b, c, d = first, first + columns + 1, first + columns + 2, first + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.uint32)
    return Mesh(places.astype(np.float32), np.stack([u, v], axis=1).astype(np.float32), faces)


@cache
def sky() -> EnvironmentMap:
    """Dim, with three bright areas."""
    H = 24
    theta, phi = np.meshgrid(
        (np.arange(H) + 0.5) / H * np.pi, np.pi - (np.arange(2 * H) + 0.5) / H * np.pi, indexing="ij"
    )
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    light = np.full((H, 2 * H, 3), 0.2)
    for place, colour in (((1, 0.3, 0.6), (6, 5, 4)), ((-0.5, 0.8, 0.2), (3, 4, 6)), ((-0.4, -0.8, 0.7), (5, 5, 5))):
        axis = np.array(place) / np.linalg.norm(place)
        light += np.exp(40 * (d @ axis - 1))[..., None] * colour
    return EnvironmentMap(light.astype(np.float32))


def lit(normals: np.ndarray, towards: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """(p, 3) sRGB of points: the rendering equation as a sum over the map, without split sum or prefiltering."""
    H = len(sky().radiance)
    theta, phi = np.meshgrid(
        (np.arange(H) + 0.5) / H * np.pi, np.pi - (np.arange(2 * H) + 0.5) / H * np.pi, indexing="ij"
    )
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    power = (sky().radiance * (np.sin(theta) * (np.pi / H) ** 2)[..., None]).reshape(-1, 3).astype(np.float64)
    nl, nv = np.maximum(normals @ d.T, 0), np.maximum((normals * towards).sum(axis=1), 1e-4)[:, None]
    length = np.sqrt(2 + 2 * towards @ d.T)
    nh, vh = (normals @ d.T + nv) / length, length / 2
    squared = (ROUGHNESS[kind] ** 4)[:, None]
    ggx = squared / (np.pi * (nh * nh * (squared - 1) + 1) ** 2)
    smith = nl * np.sqrt(nv * nv * (1 - squared) + squared) + nv * np.sqrt(nl * nl * (1 - squared) + squared)
    fresnel = 0.04 + 0.96 * (1 - vh) ** 5
    highlight = SPECULAR[kind][:, None] * ((ggx * 0.5 / smith * fresnel * nl) @ power)
    light = ALBEDO[kind] / np.pi * (nl @ power) + highlight
    return np.asarray(np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055))


@cache
def photographs(first: int = 0, count: int = 16, edge: int = 32) -> Views:
    cameras, pictures = [], []
    for i in range(first, first + count):
        camera = Camera(
            edge, edge, 1.3 * edge, look_at(np.zeros(3), 2.4 * i, (-0.9, -0.3, 0.2, 0.7, 1.2)[i % 5], 3.2), f"{i}"
        )
        origin, rays = (np.asarray(each, np.float64) for each in camera.rays())
        origin, rays = np.broadcast_to(origin, (edge * edge, 3)), rays.reshape(-1, 3)
        along = (origin * rays).sum(axis=1)
        depth = along**2 - (origin * origin).sum(axis=1) + 1
        hit = depth > 0
        n = (origin + (-along - np.sqrt(np.maximum(depth, 0)))[:, None] * rays)[hit]
        colours = np.zeros((edge * edge, 4))
        colours[hit, :3], colours[hit, 3] = lit(n, -rays[hit], (n[:, 1] < 0).astype(int)), 1
        pictures.append(np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8).reshape(edge, edge, 4))
        cameras.append(camera)
    return Views(Cameras(tuple(cameras)), tuple(pictures), (0.0, 0.0, 0.0), False)


@pytest.mark.long
def test_two_materials_come_back_and_predict_other_views() -> None:
    found = fit_materials(ball(), photographs(), sky(), edge=EDGE, samples=1)
    mesh = found.mesh
    assert mesh.material is not None
    assert mesh.texture is not None
    assert sum(material.share for material in found.clusters) == pytest.approx(1)
    for kind, columns in ((0, slice(6, 26)), (1, slice(38, 58))):
        own = mesh.material[10:54, columns].reshape(-1, 2) / 255
        roughness, specular = np.median(own, axis=0)
        assert abs(roughness - ROUGHNESS[kind]) < 0.08, found.clusters
        assert abs(specular / SPECULAR[kind] - 1) < 0.2, found.clusters
        shown = np.median(mesh.texture[10:54, columns].reshape(-1, 3) / 255, axis=0)
        true = 1.055 * ALBEDO[kind] ** (1 / 2.4) - 0.055
        np.testing.assert_allclose(shown, true, atol=0.05)
    psnr = light_pixels(mesh, photographs(100, 2), sky(), samples=1)
    assert min(psnr) > 30, psnr


def test_a_black_map_is_refused() -> None:
    black = EnvironmentMap(np.zeros((2, 4, 3), np.float32))
    with pytest.raises(InvalidScene, match="the environment map is black"):
        fit_materials(ball(), photographs(0, 2, 8), black, edge=EDGE)
