"""Baking: what a few colours must give, laws for every method, and the real texture."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nerfbake
from nerfbake import bake_atlas, measure_atlas_error
from nerfbake.errors import InvalidScene
from nerfbake.io import load_folder
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface import mlp, octahedron
from nerfbake.scene.atlas import METHODS, Method, tetrahedron
from nerfbake.scene.stage1 import SpecularField
from tests.support.atlas_scenes import field

DIRECTIONS = fibonacci(100)
PLAIN_AND_OTHERS: list[tuple[Method, int]] = [("kmeans", 64), ("affine", 16), ("grid", 1)]


def two_colours() -> SpecularField:
    """Three texels of one colour, one of another."""
    scene = field(2, 2)
    features = np.array([[[10, 20, 30], [10, 20, 30]], [[10, 20, 30], [200, 90, 40]]], np.uint8)
    return replace(scene, features=features)


def test_as_many_clusters_as_colours_are_the_colours() -> None:
    scene = two_colours()
    atlas = bake_atlas(scene, clusters=2, map_size=16)
    assert atlas.labels.tolist() == [[0, 0], [0, 1]]
    colours = np.array([[10, 20, 30], [200, 90, 40]]) / 255
    shown = mlp.evaluate(colours, octahedron.texel_directions(16), scene.w0, scene.w1)
    expected = np.rint(255 * shown.reshape(2, 3, 16, 16).transpose(0, 2, 3, 1))
    np.testing.assert_array_equal(atlas.tiles, expected)


def test_one_cluster_snaps_to_the_colour_that_most_texels_have() -> None:
    atlas = bake_atlas(two_colours(), clusters=1, map_size=4)
    np.testing.assert_array_equal(atlas.tiles, bake_atlas(two_colours(), clusters=2, map_size=4).tiles[:1])


def test_the_mean_of_a_cluster_weighs_its_texels() -> None:
    colours = bake_atlas(two_colours(), clusters=2, map_size=8).tiles.astype(float)
    mean = bake_atlas(two_colours(), clusters=1, map_size=8, centres="mean").tiles[0]
    assert np.abs(mean - (3 * colours[0] + colours[1]) / 4).max() <= 1


def test_unused_texels_do_not_weigh() -> None:
    scene = field()
    background = scene.features.copy()
    background[:, 16:] = [255, 0, 255]
    used = np.zeros(scene.used.shape, bool)
    used[:, :16] = True
    narrow = SpecularField(np.ascontiguousarray(scene.features[:, :16]), scene.w0, scene.w1, used[:, :16])
    wide = SpecularField(background, scene.w0, scene.w1, used)
    for method in METHODS:
        first, second = (bake_atlas(s, method=method, clusters=5, nodes=3, map_size=8) for s in (narrow, wide))
        np.testing.assert_array_equal(first.tiles, second.tiles)


@pytest.mark.parametrize("method", METHODS)
def test_more_maps_come_closer(method: Method) -> None:
    scene = field(60, 80)
    few = bake_atlas(scene, method=method, clusters=4, nodes=2, map_size=32)
    many = bake_atlas(scene, method=method, clusters=64, nodes=5, map_size=32)
    errors = [measure_atlas_error(atlas, scene, directions=DIRECTIONS) for atlas in (few, many)]
    assert errors[1].mse_float < 0.6 * errors[0].mse_float


def test_affine_and_grid_beat_plain_maps_of_the_same_number() -> None:
    scene = field(60, 80)
    plain, affine, grid = (
        measure_atlas_error(
            bake_atlas(scene, method=method, clusters=K, nodes=4, map_size=32), scene, directions=DIRECTIONS
        )
        for method, K in PLAIN_AND_OTHERS
    )
    assert max(affine.mse_float, grid.mse_float) < plain.mse_float


def test_affine_offsets_are_the_features_without_loss() -> None:
    scene = field()
    atlas = bake_atlas(scene, method="affine", clusters=6, map_size=8)
    assert atlas.features is not None
    centres = scene.features.astype(int) - (atlas.features.astype(int) - 127)
    for label in np.unique(atlas.labels):
        assert len(np.unique(centres[atlas.labels == label], axis=0)) == 1


def test_tetrahedra_by_hand_and_everywhere() -> None:
    # n = 2: the cube of all colours. Red first, then blue, then green.
    nodes, weights = tetrahedron(np.array([[204, 51, 102]], np.uint8), 2)
    assert nodes.tolist() == [[0, 4, 5, 7]]
    np.testing.assert_allclose(weights, [[0.2, 0.4, 0.2, 0.2]], atol=1e-6)
    features = np.random.default_rng(1).integers(0, 256, (5000, 3), np.uint8)
    for n in (2, 3, 7, 16):
        nodes, weights = tetrahedron(features, n)
        assert weights.min() > -1e-6
        places = np.stack(np.unravel_index(nodes, (n, n, n)), axis=-1) * 255 / (n - 1)
        np.testing.assert_allclose((weights[..., None] * places).sum(axis=1), features, atol=1e-2)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"clusters": 0}, "clusters is 0; allowed: 1 to 2"),
        ({"clusters": 3}, "the texture has 2 colours"),
        ({"map_size": 1}, "map size is 1; allowed: 2 to 1024"),
        ({"method": "grid", "nodes": 40}, "nodes is 40; allowed: 2 to 16"),
        ({"clusters": 2, "border": 33}, "border is 33; allowed: 0 to 32"),
    ],
)
def test_sizes_out_of_range_are_refused(options: dict[str, object], named: str) -> None:
    with pytest.raises(InvalidScene, match=named):
        bake_atlas(two_colours(), **options)  # type: ignore[arg-type]


DIGEST = """
import hashlib
from nerfbake import bake_atlas
from tests.support.atlas_scenes import field
for method in ("kmeans", "affine", "grid"):
    atlas = bake_atlas(field(45, 60), method=method, clusters=50, map_size=16, nodes=4)
    print(hashlib.sha256(atlas.tiles.tobytes()).hexdigest(), hashlib.sha256(atlas.labels.tobytes()).hexdigest())
"""


@pytest.mark.long
def test_same_seed_same_bytes_whatever_the_number_of_threads() -> None:
    digests = set()
    for threads in ("1", "3"):
        names = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, threads)}
        command = [sys.executable, "-c", DIGEST]
        digests.add(subprocess.run(command, env=environment, capture_output=True, check=True, text=True).stdout)
    assert len(digests) == 1
    here = bake_atlas(field(45, 60), clusters=50, map_size=16)
    assert digests.pop().split()[0] == hashlib.sha256(here.tiles.tobytes()).hexdigest()


def test_another_seed_is_another_start() -> None:
    scene = field(60, 80)
    first, second = (bake_atlas(scene, clusters=20, map_size=4, seed=seed) for seed in (0, 1))
    assert not np.array_equal(first.labels, second.labels)


@pytest.fixture(scope="module")
def real_texture(data: Path) -> SpecularField:
    """Every fourth texel along each axis: a sixteenth of the work, and all errors within 4 % of the whole texture's."""
    whole = load_folder(data / "nerf2mesh" / "mesh_stage1", nerfbake.Stage1).fields[0]
    features = np.ascontiguousarray(whole.features[::4, ::4])
    return replace(whole, features=features, used=np.ascontiguousarray(whole.used[::4, ::4]))


@pytest.mark.data
@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "K", "mae", "mse"),
    [("kmeans", 64, 1.536, 12.85), ("kmeans", 256, 0.990, 5.56), ("affine", 64, 0.46, 1.1), ("grid", 1, 0.44, 2.05)],
)
def test_the_real_texture(real_texture: SpecularField, method: Method, K: int, mae: float, mse: float) -> None:
    scene = real_texture
    error = measure_atlas_error(bake_atlas(scene, method=method, clusters=K), scene, directions=DIRECTIONS)
    # Sections 4 and 5 of the specification: as 8-bit pictures hold them, and before rounding.
    found = (error.mae, error.mse) if method == "kmeans" else (error.mae_float, error.mse_float)
    assert found[0] <= mae
    assert found[1] <= mse
