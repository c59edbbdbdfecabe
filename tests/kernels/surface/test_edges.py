"""Edges of meshes, with trimesh as the oracle."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import numpy.typing as npt
import pytest
from trimesh import graph

from nerfbake.kernels.surface.edges import mesh_edges
from nerfbake.kernels.surface.triangles import parts_of, rim_of
from tests.support.meshes import sphere

Facts = tuple[int, bool, bool]


def facts_of(faces: npt.NDArray[np.int64], count: int) -> Facts:
    edges = mesh_edges(faces, count)
    return edges.count_pieces(count), edges.closed, edges.same_winding


def judged(faces: npt.NDArray[np.int64]) -> Facts:
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    closed, same_winding = graph.is_watertight(edges)
    labels = graph.connected_component_labels(edges)  # type: ignore[no-untyped-call]
    return len(np.unique(labels[faces[:, 0]])), closed, same_winding


def test_two_triangles_by_hand() -> None:
    edges = mesh_edges(np.array([[0, 1, 2], [2, 1, 4]]), 5)
    assert edges.low.tolist() == [0, 0, 1, 1, 2]
    assert edges.high.tolist() == [1, 2, 2, 4, 4]
    assert edges.times.tolist() == [1, 1, 2, 1, 1]
    assert edges.balance.tolist() == [1, -1, 0, 1, -1]
    assert facts_of(np.array([[0, 1, 2], [2, 1, 4]]), 5) == (1, False, True)
    assert facts_of(np.array([[0, 1, 2], [1, 2, 4]]), 5) == (1, False, False)


@pytest.mark.slow
def test_the_facts_are_those_of_trimesh() -> None:
    # Closed surfaces, holes, several pieces, faces that are turned over, and edges of three faces and more.
    random = np.random.default_rng(0)
    found = set()
    for _ in range(400):
        count = int(random.integers(3, 40))
        if random.random() < 0.5:
            whole = sphere().faces
            faces = np.concatenate([whole + i * (whole.max() + 1) for i in range(random.integers(1, 3))])
            count = int(faces.max()) + 1
            faces = faces[random.random(len(faces)) < random.choice([1, 1, 0.97])]
            turned = random.random(len(faces)) < random.choice([0, 0, 0.02])
            faces[turned] = faces[turned, ::-1]
            faces = random.permutation(count)[faces]
        else:
            faces = np.array([random.choice(count, 3, replace=False) for _ in range(random.integers(1, 30))])
        facts = facts_of(faces, count)
        assert facts == judged(faces)
        assert facts[0] == parts_of(faces, count).max() + 1
        found.add((facts[0] > 1, *facts[1:]))
    assert len(found) >= 7


def test_the_rim_is_where_an_edge_has_not_one_face_on_either_side() -> None:
    ball = sphere()
    count = len(ball.positions)
    assert not rim_of(ball.faces, count).any()
    assert set(np.flatnonzero(rim_of(ball.faces[1:], count))) == set(ball.faces[0].tolist())


def test_a_long_strip_is_one_piece_in_any_order() -> None:
    n = 4096
    strip = np.stack([np.arange(n - 2) + k for k in range(3)], axis=1)
    from_both_ends = np.stack([np.arange(n // 2), n - 1 - np.arange(n // 2)], axis=1).reshape(-1)
    for numbers in (np.arange(n), np.arange(n)[::-1], from_both_ends, np.random.default_rng(1).permutation(n)):
        assert mesh_edges(numbers[strip], n).count_pieces(n) == 1
        assert mesh_edges(numbers[strip[: n // 2]], n).count_pieces(n) == 1
        assert mesh_edges(numbers[np.delete(strip, [n // 2, n // 2 + 1], axis=0)], n).count_pieces(n) == 2


def test_a_mesh_is_described_without_numba_and_trimesh() -> None:
    code = """if True:
        import sys
        sys.modules.update(dict.fromkeys(["trimesh", "scipy", "numba"]))
        from nerfbake import Meshes, summarise_scene
        from tests.support.meshes import cube
        facts = summarise_scene(Meshes((cube(),)))
        assert (facts["pieces"], facts["closed"], facts["same_winding"]) == (1, True, True)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
