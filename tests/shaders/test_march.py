"""The marcher's twins in each language show what `nerfbake render` does, wherever an engine puts the object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import (
    Camera,
    N3Tree,
    PageField,
    RadianceField,
    SparseVoxelOctree,
    build_field,
    build_octree,
    build_page_field,
    load,
    orbit_cameras,
    render_field,
    round_field,
    sample_n3tree,
)
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from tests.support.marching import AXES, marched
from tests.support.shaders import Runner

EDGE = 100


def seen(field: RadianceField) -> Camera:
    return orbit_cameras(field, width=EDGE, height=EDGE).cameras[0]


def share_off(found: npt.NDArray[np.float32], wanted: npt.NDArray[np.float32]) -> float:
    """The share of channels (0 to 1) that are further apart than a step of 8 bits."""
    return float((np.abs(found[:, :3] - wanted.reshape(-1, 3)) > 1 / 255).mean())


@pytest.mark.data
@pytest.mark.slow
def test_the_chair_is_what_render_shows(runner: Runner, real: RadianceField, real_page: PageField) -> None:
    camera = seen(real)
    found = marched(runner, real_page, *camera.rays())
    image = render_field(real, camera)
    assert share_off(found, image.colour) <= 1e-3
    solid = image.alpha.ravel() > 0.99
    assert solid.mean() > 0.1
    np.testing.assert_allclose(found[solid, 3], image.depth.ravel()[solid], rtol=1e-3)


@pytest.fixture(scope="module")
def real(chair: Path) -> RadianceField:
    return round_field(build_field(load(chair / "chair_sh9_128.npz", N3Tree)))


@pytest.fixture(scope="module")
def real_page(real: RadianceField) -> PageField:
    return build_page_field(real)


@pytest.fixture(scope="module")
def octree() -> SparseVoxelOctree:
    """SH16 over a box that is no cube."""
    return build_octree(sample_n3tree(resolution=32, basis="SH16"), resolution=(24, 32, 17))


@pytest.fixture(scope="module")
def field(octree: SparseVoxelOctree) -> RadianceField:
    return round_field(build_field(octree))


@pytest.fixture(scope="module")
def page(field: RadianceField) -> PageField:
    return build_page_field(field)


def test_a_ray_stops_at_what_stands_in_its_way(runner: Runner, field: RadianceField, page: PageField) -> None:
    camera = seen(field)
    free = render_field(field, camera)
    depth = np.where(free.alpha > 0.5, free.depth, 1.0).astype(np.float64)
    stop = np.random.default_rng(0).uniform(0.8, 1.2, depth.shape) * depth
    found = marched(runner, page, *camera.rays(), stop=stop.ravel())
    stopped = render_field(field, camera, stop=stop)
    assert share_off(found, stopped.colour) <= 1e-3
    assert share_off(found, free.colour) > 0.05


def test_a_cutout_is_opaque_or_not_there(runner: Runner, field: RadianceField, page: PageField) -> None:
    camera = seen(field)
    found = marched(runner, page, *camera.rays(), cut=0.5, cutout=True)
    image = render_field(field, camera, background=None, transmittance_cut=0.5)
    alpha = image.alpha.ravel()
    clear = np.abs(alpha - 0.5) > 1e-4
    assert (found[clear, 3] == (alpha > 0.5)[clear]).all()
    shown = clear & (alpha > 0.5)
    assert 0.05 < shown.mean() < 0.95
    assert share_off(found[shown], image.colour.reshape(-1, 3)[shown] / alpha[shown, None]) <= 1e-3


RED, GREEN, BLUE = (1, 0, 0), (0, 1, 0), (0, 0, 1)
CYAN, MAGENTA, YELLOW = (0, 1, 1), (1, 0, 1), (1, 1, 0)
# Seen from the engine's +x, -x, +y, -y, +z, -z, of a field whose right is red, whose back is green, whose top is blue:
# engines with y up see the top from +y; Unity has the back at +z, three.js, whose z comes towards the viewer, at -z.
SIDES = {
    "Z_UP": (RED, CYAN, GREEN, MAGENTA, BLUE, YELLOW),
    "Y_UP": (RED, CYAN, BLUE, YELLOW, MAGENTA, GREEN),
    "Y_UP_LEFT": (RED, CYAN, BLUE, YELLOW, GREEN, MAGENTA),
}


def die() -> SparseVoxelOctree:
    """4^3 voxels about the origin: each side has the colour that SIDES["Z_UP"] tells."""
    children = np.zeros((73, 8), np.int32)
    children[:9] = np.arange(1, 73).reshape(9, 8)
    i = np.arange(64)
    voxel = [(i >> 3 + axis & 1) * 2 + (i >> axis & 1) for axis in range(3)]
    data = np.zeros((73, 4), np.float32)
    for side, colour in enumerate(SIDES["Z_UP"]):
        data[9:][voxel[side // 2] == (0 if side % 2 else 3), :3] = 200 * np.array(colour) - 100
    data[9:, 3] = 1000
    return SparseVoxelOctree((4, 4, 4), children, data, "SH1", np.full(3, -2.0))


@pytest.mark.parametrize("axes", AXES)
def test_each_side_is_where_the_engine_expects_it(runner: Runner, axes: str) -> None:
    page = build_page_field(build_field(die()))
    for side, colour in enumerate(SIDES[axes]):
        outward = np.eye(3)[side // 2] * (-1 if side % 2 else 1)
        eye = 9 * outward + 0.3  # beside the middle, where four voxels meet
        found = marched(runner, page, eye, -outward[None], axes=axes)
        np.testing.assert_allclose(found[0, :3], colour, atol=1e-3)
        assert found[0, 3] == pytest.approx(7 + 0.3 * outward.sum(), abs=0.01)


def a_quarter_turned(octree: SparseVoxelOctree) -> SparseVoxelOctree:
    """The same scene turned about z, from x to y: other nodes, other coefficients."""
    octant = np.arange(8)
    x, y, z = octant & 1, octant >> 1 & 1, octant >> 2
    children = np.zeros_like(octree.node_children)
    children[:, (1 - y) + 2 * x + 4 * z] = octree.node_children
    B = (octree.data_dim - 1) // 3
    looks = fibonacci(400)
    turned = np.stack([-looks[:, 1], looks[:, 0], looks[:, 2]], axis=1)
    # Coefficients that say of the turned look what the old ones say of the look.
    matrix = np.linalg.lstsq(sh_basis(turned, B), sh_basis(looks, B), rcond=None)[0]
    data = octree.node_data.astype(np.float64)
    data[:, :-1] = (data[:, :-1].reshape(-1, 3, B) @ matrix.T).reshape(-1, 3 * B)
    turned_octree = replace(octree, node_children=children, node_data=data.astype(np.float32))
    return turned_octree.breadth_first()


@pytest.mark.parametrize("axes", AXES)
def test_harmonics_turn_with_the_object(runner: Runner, axes: str) -> None:
    """The object, turned by the engine, looks like a field that was turned itself."""
    octree = build_octree(sample_n3tree(resolution=32, basis="SH16"))
    edge = octree.size[0] * octree.voxel_size
    octree = replace(octree, origin=-edge / 2, node_data=octree.node_data.astype(np.float32))
    field = round_field(build_field(octree))
    turned = round_field(build_field(a_quarter_turned(octree)))
    camera = seen(turned)
    eye, looks = camera.rays()
    # The engine's world, of the field's: where the camera is there, and what undoes the object's turn there.
    engine = {"Z_UP": np.eye(3), "Y_UP": np.eye(3)[[0, 2, 1]] * [[1], [1], [-1]], "Y_UP_LEFT": np.eye(3)[[0, 2, 1]]}[
        axes
    ]
    back = engine @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ engine.T
    to_object = np.column_stack([back, np.zeros(3)])
    page = build_page_field(field)
    found = marched(runner, page, engine @ eye, looks @ engine.T, axes=axes, to_object=to_object)
    wanted = render_field(turned, camera).colour
    assert share_off(found, wanted) <= 1e-3
    assert share_off(found, render_field(field, camera).colour) > 0.05
