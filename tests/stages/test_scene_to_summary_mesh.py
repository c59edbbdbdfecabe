from __future__ import annotations

import numpy as np

from nerfbake import Mesh, Meshes, summarise_scene
from nerfbake.memory import memory_limit
from tests.support.meshes import cube, mesh, sphere, square


def surface(*meshes: Mesh) -> tuple[int, bool, bool]:
    facts = summarise_scene(Meshes(meshes))
    return facts["pieces"], facts["closed"], facts["same_winding"]


def moved(one: Mesh, x: float) -> Mesh:
    return mesh(one.positions + np.array([x, 0, 0]), one.faces)


def split(one: Mesh) -> Mesh:
    """The same with three vertices of its own for each triangle, as texture coordinates may ask for."""
    return mesh(one.positions[one.faces.reshape(-1)], np.arange(one.faces.size).reshape(-1, 3))


def test_a_cube_is_one_closed_piece_however_its_vertices_are_split() -> None:
    assert surface(cube()) == (1, True, True)
    assert surface(split(cube())) == (1, True, True)
    assert surface(split(sphere())) == (1, True, True)


def test_a_square_is_open() -> None:
    assert surface(square()) == (1, False, True)


def test_pieces_are_counted_over_all_meshes_of_the_file() -> None:
    assert surface(cube(), moved(cube(), 2)) == (2, True, True)
    # Two halves of one cube, as two materials have it.
    whole = split(cube())
    assert surface(mesh(whole.positions, whole.faces[:6]), mesh(whole.positions, whole.faces[6:])) == (1, True, True)
    # A corner that is shared is a touch.
    assert surface(cube(), mesh(cube().positions + 1, cube().faces)) == (1, True, True)


def test_a_triangle_that_faces_the_other_way_is_told() -> None:
    faces = cube().faces.copy()
    faces[0] = faces[0, ::-1]
    assert surface(mesh(cube().positions, faces)) == (1, True, False)


def test_zero_has_no_sign_here() -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, -0.0], [1, -0.0, 0], [0, -1, 0]])
    assert surface(mesh(positions, [[0, 1, 2], [3, 5, 4]]))[0] == 1


def test_triangles_that_are_lines_do_not_count() -> None:
    faces = np.concatenate([cube().faces, [[0, 0, 1], [7, 7, 7]]])
    assert surface(mesh(cube().positions, faces)) == (1, True, True)
    assert surface(mesh(np.zeros((3, 3)), [[0, 1, 2]])) == (0, False, True)


def test_what_does_not_fit_is_left_open() -> None:
    scene = Meshes((sphere(),))
    with memory_limit(100_000):
        facts = summarise_scene(scene)
    assert (facts["pieces"], facts["closed"], facts["same_winding"]) == (None, None, None)
    assert facts["triangles"] == len(sphere().faces)


def test_as_many_pieces_as_triangles_far_from_each_other() -> None:
    t = 20_000
    positions = np.random.default_rng(0).normal(size=(3 * t, 3)) * 1e14
    assert surface(mesh(positions, np.arange(3 * t).reshape(-1, 3))) == (t, False, True)
