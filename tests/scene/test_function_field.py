from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.function_field import FunctionField, Occupancy
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network
from nerfbake.scene.sparse_points import SparsePoints

BOX = np.array([[-1.0] * 3, [1.0] * 3])
TURN = np.array([[0.0, -2.0, 0.0, 0.5], [2.0, 0.0, 0.0, -0.25], [0.0, 0.0, 2.0, 0.125]])  # a quarter turn about z


def linear(frame: Floats | None = None) -> FunctionField:
    """A field whose density is 10 + x + 2 y + 3 z, and whose red is the sigmoid of the direction's x."""
    trunk = Mlp((np.array([[1, 2, 3]], np.float32),), (np.array([10], np.float32),))
    red = np.zeros((3, 4), np.float32)
    red[0, 1] = 1
    colour = HeadColour(Mlp((red,), (np.zeros(3, np.float32),)), Frequencies(np.zeros(0)))
    network = Network(Frequencies(np.zeros(0)), trunk, np.ones(1, np.float32), 0.0, Activation(), colour)
    return FunctionField(network, np.eye(3, 4) if frame is None else frame, BOX)


def test_the_frame_turns_points_directions_and_densities() -> None:
    field, points = linear(TURN), np.array([[0.125, 0.25, -0.25], [-0.25, 0.0, 0.0]])
    own = points @ TURN[:, :3].T + TURN[:, 3]
    density, features = field.density(points)
    assert_allclose(density, 2 * (10 + own @ [1, 2, 3]), rtol=1e-6)  # per unit of the world, twice as long
    colours = field.colour(features, np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]))
    assert_allclose(colours[:, 0], 1 / (1 + np.exp([-1.0, 1.0])), rtol=1e-6)


def test_outside_of_the_box_is_empty() -> None:
    density, features = linear().density(np.array([[1.0, 0, 0], [0.999, 0, 0], [0, -1.5, 0]]))
    assert_array_equal(density > 0, [False, True, False])
    assert_array_equal(features[[0, 2]], 0)


def test_a_contracted_field_covers_all_of_space() -> None:
    field = replace(linear(), contracted=True)
    near, far = np.array([[0.5, -0.25, 0.125]]), np.array([[4.0, -2.0, 1.0]])
    assert_array_equal(field.density(near)[0], linear().density(near)[0])
    place = (2 - 1 / 4) * far / 4
    assert_allclose(field.density(far)[0], 10 + place @ [1, 2, 3], rtol=1e-6)


def test_the_smallest_box_with_a_point_decides_where_there_may_be_a_density() -> None:
    cells = np.zeros((2, 2, 2, 2), bool)
    cells[0, 1, 0, 0] = cells[1, 0, 0, 0] = True
    boxes = np.array([BOX / 2, BOX])
    field = replace(linear(), occupied=Occupancy(cells, boxes))
    points = np.array([[0.25, -0.25, -0.25], [-0.25, -0.25, -0.25], [-0.75, -0.75, -0.75], [0.75, 0.75, 0.75]])
    assert_array_equal(field.density(points)[0] > 0, [True, False, True, False])


def test_cells_may_be_longer_along_an_axis() -> None:
    cells = np.zeros((1, 1, 2, 4), bool)
    cells[0, 0, 1, 2] = True
    field = replace(linear(), occupied=Occupancy(cells, BOX[None]))
    points = np.array([[0.9, 0.5, 0.25], [-0.9, 0.1, 0.4], [0.0, -0.5, 0.25], [0.0, 0.5, 0.75]])
    assert_array_equal(field.density(points)[0] > 0, [True, True, False, False])


def test_the_trained_world_takes_the_cameras_along() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [0.125, 0.25, -0.25]
    field = replace(linear(TURN), cameras=Cameras((Camera(4, 3, 5.0, pose),)))
    trained = field.in_trained_world()
    assert trained.cameras is not None
    assert field.cameras is not None
    eye, own = field.cameras.eyes, trained.cameras.eyes
    assert_allclose(field.density(eye)[0], 2 * trained.density(own)[0], rtol=1e-6)
    assert_allclose(trained.cameras.axes, field.cameras.axes @ TURN[:, :3].T / 2, atol=1e-12)


def test_the_box_in_the_world_is_around_the_trained_one() -> None:
    assert_allclose(linear(TURN).world_box, [[-0.375, -0.25, -0.5625], [0.625, 0.75, 0.4375]])


def test_no_point_is_no_density() -> None:
    density, features = linear().density(np.empty((0, 3)))
    assert density.shape == (0,)
    assert features.shape == (0, 1)


def test_a_frame_that_is_skewed_is_a_problem() -> None:
    skewed = TURN.copy()
    skewed[0, 0] = 1
    assert [problem.place for problem in linear(skewed).problems()] == ["the field's frame"]
    assert linear(TURN).problems() == []


def test_sparse_points_turn_with_their_cameras() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [0.125, 0.25, -0.25]
    points = SparsePoints(pose[None, :3, 3] + [[0.0, 0.0, -1.0]])
    moved = Cameras((Camera(4, 3, 5.0, pose),), points=points).transformed(TURN)
    assert moved.points is not None
    assert_allclose(moved.points.positions - moved.eyes, 2 * moved.axes, atol=1e-12)
