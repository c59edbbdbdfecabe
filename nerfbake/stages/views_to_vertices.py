"""Posed pictures, mesh -> the mesh with its vertices where the pictures show them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.maths.affine import inverse, length, rotate
from nerfbake.kernels.parallel import in_order
from nerfbake.kernels.surface.gbuffer import GBuffer, gbuffer
from nerfbake.kernels.surface.motion import (
    Equations,
    Solid,
    SurfaceEye,
    add_rims,
    add_smoothness,
    add_texels,
    edges_of,
    limit_offsets,
    solve_offsets,
)
from nerfbake.kernels.surface.normals import doubled_areas, face_normals
from nerfbake.kernels.surface.triangles import untangled, vertex_normals
from nerfbake.scene.camera import Camera
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.views import Views
from nerfbake.stages._ray_targets import reduced_view

_PIXELS = 400  # along a picture's longer edge, about: pictures are reduced by a whole factor
_VIEWS = 50  # a round
_RIM_NOISE = 0.3  # pixels
_COLOUR_NOISE = 0.05  # of 1
_SMOOTH = 3.0  # of the mean of the equations' diagonal: how much neighbours should move alike
_STILL = 0.003  # of the same mean: how much vertices that no picture moves should stay
_SOLVER = 60  # most steps of the solver
_MOST = 0.5  # of the mean length of a vertex's edges: how far it may move in one round
_LEAST_COSINE = 0.5  # between a face's normals before and after a round
_HALVINGS = 6
_UNTANGLING = 5  # most rounds, after small turns have added up
_NEAREST = 1e-6  # world units between a camera and the mesh's middle
_FACE_BYTES, _PIXEL_BYTES = 400, 220


def move_vertices(mesh: Mesh, views: Views, *, rounds: int = 1) -> Mesh:
    """Return the mesh with its vertices moved along their normals, to where the pictures show the surface.

    Where the mesh's rim is seen in front of the background, it moves to the rim of the picture's alpha; without alpha,
    of what differs from the plain background. If the mesh has a texture, its faces also move to where the texture has
    the pictures' colours: compute the texture anew between rounds. Each round uses up to 50 of the pictures. All else
    of the mesh stays; vertices at one position, as along the seams of a texture, move together. No face turns over.

    Raises InvalidScene for pictures in which nothing of the mesh can be compared, MemoryLimit.

    >>> from nerfbake import Views, build_field, build_surface, move_vertices, render_field
    >>> from nerfbake import sample_n3tree, scatter_cameras
    >>> field = build_field(sample_n3tree(resolution=32))
    >>> cameras = scatter_cameras(field, frames=8, edge=48)
    >>> pictures = tuple(render_field(field, camera, background=None).pixels for camera in cameras.cameras)
    >>> mesh = build_surface(field, cameras, triangles=500)
    >>> moved = move_vertices(mesh, Views(cameras, pictures, (1.0, 1.0, 1.0), True))
    >>> moved.positions.shape == mesh.positions.shape
    True
    """
    memory.require("moving the vertices", _FACE_BYTES * len(mesh.faces))
    # Vertices at one position are one unknown.
    _, first, number = np.unique(mesh.positions, axis=0, return_index=True, return_inverse=True)
    number = number.reshape(-1)
    positions = mesh.positions[first].astype(np.float64)
    faces = number[mesh.faces].astype(np.int64)
    edges, beside = edges_of(faces)
    texture = _texture(mesh, views)
    every = -(-len(views.pictures) // _VIEWS)
    for turn in range(rounds):
        facing = face_normals(positions, faces)
        size = np.sqrt((facing * facing).sum(axis=1))[:, None]
        facing = np.divide(facing, size, out=np.zeros_like(facing), where=size > 0)
        solid = Solid(positions, vertex_normals(positions, faces), faces, facing, edges, beside)
        blocks = Equations(np.zeros((len(faces), 6)), np.zeros((len(faces), 3)))
        chosen = range(turn % every, len(views.pictures), every)
        with progress.part(turn / rounds, (turn + 1) / rounds):
            looks = in_order((partial(_look, solid, views, view) for view in chosen), most=_most_at_once(views))
            for _ in progress.each(chosen):
                _add_view(solid, mesh, texture, views, next(looks), blocks)
        held = blocks.left[:, [0, 3, 5]]
        if not held.any():
            found = "show nothing that can be compared with the mesh"
            raise InvalidScene(Problem("the pictures", found, "pictures of the mesh's object"))
        mean = float(held[held > 0].mean())
        add_smoothness(faces, _SMOOTH * mean, _STILL * mean, blocks)
        offset = solve_offsets(faces, len(positions), blocks, _SOLVER)
        limit_offsets(solid, offset, _MOST, _LEAST_COSINE, _HALVINGS)
        positions = untangled(positions + offset[:, None] * solid.normals, faces, _UNTANGLING)
    return memory.kept(replace(mesh, positions=positions[number].astype(np.float32)))


def _texture(mesh: Mesh, views: Views) -> Singles | None:
    """The mesh's texture, (H, W, 3) in 0..1, halved until its texels are about as large as the pictures' pixels."""
    if mesh.texture is None or mesh.uvs is None:
        return None
    texture = mesh.texture.astype(np.float32) / np.float32(255)
    corners = mesh.uvs[mesh.faces].astype(np.float64) * texture.shape[1::-1]
    (a, b), (c, d) = (np.moveaxis(corners[:, k] - corners[:, 0], 1, 0) for k in (1, 2))
    texels = np.abs(a * d - b * c).sum() / doubled_areas(mesh.positions, mesh.faces).sum()  # in a square world unit
    middle = mesh.positions.mean(axis=0, dtype=np.float64)
    away = [max(length(camera.pose[:3, 3] - middle), _NEAREST) for camera in views.cameras.cameras]
    pixels = [c.fx / _scale(c) / far for c, far in zip(views.cameras.cameras, away, strict=True)]
    finest = float(np.median(pixels))  # in a world unit
    while texels >= (2 * finest) ** 2 and not (texture.shape[0] % 2 or texture.shape[1] % 2):
        texture = (texture[::2, ::2] + texture[1::2, ::2] + texture[::2, 1::2] + texture[1::2, 1::2]) / np.float32(4)
        texels /= 4
    return texture


def _scale(camera: Camera) -> int:
    """How many pixels along an edge are averaged before a picture is compared with the mesh."""
    return max(1, max(camera.width, camera.height) // _PIXELS)


class _Look(NamedTuple):
    """A reduced picture (H, W, 4), and the triangles that its pixels show."""

    image: Singles
    eye: SurfaceEye
    seen: GBuffer


def _most_at_once(views: Views) -> int:
    """Return how many pictures fit into the memory that is left. Raises MemoryLimit if one does not."""
    cameras = [camera.reduced(_scale(camera)) for camera in views.cameras.cameras]
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    largest.require_memory(_PIXEL_BYTES)
    return memory.left() // (2 * _PIXEL_BYTES * largest.width * largest.height)


def _look(solid: Solid, views: Views, view: int) -> _Look:
    """Look at the mesh through a view."""
    camera, image = reduced_view(views, view, _scale(views.cameras.cameras[view]))
    rays = camera.rays()[1].reshape(camera.height, camera.width, 3)
    seen = gbuffer(solid.positions.astype(np.float32), solid.faces.astype(np.uint32), camera.pose, rays)
    optics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    eye = SurfaceEye(np.ascontiguousarray(camera.pose[:3]), optics, _plane(camera, rays))
    return _Look(image, eye, seen)


def _add_view(solid: Solid, mesh: Mesh, texture: Singles | None, views: Views, look: _Look, blocks: Equations) -> None:
    """Add the equations of one picture."""
    image, eye, seen = look
    if not views.scenery and min(image.shape[:2]) > 1:
        rest = image[..., 3] - (seen.triangle >= 0).astype(np.float32)
        add_rims(solid, eye, seen.triangle, rest, 1 / (_RIM_NOISE * _RIM_NOISE), blocks)
    if texture is not None and mesh.uvs is not None:
        weight = 1 / (_COLOUR_NOISE * _COLOUR_NOISE)
        add_texels(solid, mesh.uvs, mesh.faces, texture, eye, seen.triangle, seen.weights, image, weight, blocks)


def _plane(camera: Camera, rays: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Where the pixels of a bent lens are on the plane in front of the camera; nothing for a pinhole."""
    if not camera.bends:
        return np.empty((0, 0, 2))
    looks = rotate(rays, inverse(camera.pose[:3, :3]))
    return np.ascontiguousarray(looks[..., :2] / -looks[..., 2:])
