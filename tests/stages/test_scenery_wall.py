"""The colours of the wall at the end of the outermost shell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Camera, Cameras, RadianceField, Views, build_field_from_bricks, render_field
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.basis import Basis
from nerfbake.scene.camera import look_at
from nerfbake.stages._bricks import BrickCells, cells_of_solid, field_of_cells
from nerfbake.stages._scenery import SHELLS, start_scenery, wall_of
from nerfbake.stages._scenery_wall import settle_wall

R = 32
BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])
COLOURS = np.array([[0.8, 0.2, 0.2], [0.2, 0.8, 0.2], [0.2, 0.2, 0.8], [0.8, 0.8, 0.2]])


def around(colours: Floats = COLOURS, edge: int = 24) -> Views:
    """Four cameras near the middle that look outwards, a quarter of a turn apart; each shows one colour."""
    poses = [look_at(np.zeros(3), 0.5 * np.pi * number, 0.0, -0.1) for number in range(4)]
    cameras = Cameras(tuple(Camera(edge, edge, 0.6 * edge, pose, str(i)) for i, pose in enumerate(poses)))
    pictures = tuple(
        np.concatenate([np.full((edge, edge, 3), np.rint(255 * c)), np.full((edge, edge, 1), 255)], axis=2).astype(
            np.uint8
        )
        for c in colours
    )
    return Views(cameras, pictures, (1.0, 1.0, 1.0), False, scenery=True)


def alone(B: int = 4) -> BrickCells:
    """The wall, and nothing before it; its values are random."""
    solid = np.zeros((SHELLS, R, R, R), bool)
    solid[-1] = True
    solid[-1, 1:-1, 1:-1, 1:-1] = False
    cells = cells_of_solid(solid.reshape(-1, R, R), BOX, B, 3.0)
    cells.bricks.values[:] += np.random.default_rng(0).normal(0, 0.5, len(cells.bricks.values)).astype(np.float32)
    return cells


def field_of(cells: BrickCells) -> RadianceField:
    return build_field_from_bricks(field_of_cells(cells, BOX, Basis("SH", cells.B)))


def test_the_wall_shows_what_the_photographs_show() -> None:
    views, cells = around(), alone()
    settle_wall(cells, views, BOX, np.ones((0, 3)))
    for camera, colour in zip(views.cameras.cameras, COLOURS, strict=True):
        image = render_field(field_of(cells), camera, background=None)
        assert image.alpha.min() > 0.99
        assert_allclose(image.colour[8:16, 8:16], np.broadcast_to(colour, (8, 8, 3)), atol=0.01)


def test_gains_of_views_are_not_part_of_the_wall() -> None:
    views, cells = around(0.5 * COLOURS), alone()
    settle_wall(cells, views, BOX, np.full((4, 3), 0.5))
    image = render_field(field_of(cells), views.cameras.cameras[0], background=None)
    assert_allclose(image.colour[12, 12], COLOURS[0], atol=0.02)


def test_where_no_photograph_looks_the_colour_is_that_of_the_nearest() -> None:
    views, cells = around(), alone()
    settle_wall(cells, views, BOX, np.ones((0, 3)))
    field = field_of(cells)
    steep = [look_at(np.zeros(3), 0.5 * np.pi * number, -1.0, -0.1) for number in range(4)]
    for pose, colour in zip(steep, COLOURS, strict=True):
        image = render_field(field, replace(views.cameras.cameras[0], pose=pose), background=None)
        assert image.alpha.min() > 0.99
        middle = image.colour[10:14, 10:14].mean(axis=(0, 1))
        assert np.square(middle - COLOURS).sum(axis=1).argmin() == np.square(colour - COLOURS).sum(axis=1).argmin()


def test_what_is_before_the_wall_is_not_painted_on_it() -> None:
    solid = np.zeros((SHELLS, R, R, R), bool)
    solid[-1] = True
    solid[-1, 1:-1, 1:-1, 1:-1] = False
    solid[0, 8:12, 8:24, 8:24] = True  # a grey veil of four cells before the first camera
    cells = cells_of_solid(solid.reshape(-1, R, R), BOX, 1, 0.1)
    kept = np.exp(-0.4)
    views = around(np.concatenate([kept * COLOURS[:1] + (1 - kept) * 0.5, COLOURS[1:]]))
    settle_wall(cells, views, BOX, np.ones((0, 3)))
    cells.bricks.values[cells.bricks.values == np.float32(0.1)] = 0  # the veil is gone
    image = render_field(field_of(cells), views.cameras.cameras[0], background=None)
    assert_allclose(image.colour[12, 12], COLOURS[0], atol=0.02)


@pytest.mark.parametrize("frames", [1, 4])
def test_the_wall_is_closed_whatever_the_cameras_see(frames: int) -> None:
    views = around().take(range(frames))
    cells = start_scenery(views, BOX, R, 1).cells
    assert wall_of(cells).sum() == R**3 - (R - 2) ** 3
