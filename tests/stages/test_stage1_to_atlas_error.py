"""The error of an atlas: the thesis' own figures, with its fault and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import nerfbake
from nerfbake import bake_atlas, measure_atlas_error
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.wire.picture import encode_texture
from nerfbake.io import load_folder
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface import octahedron
from nerfbake.scene.atlas import OctahedralAtlas
from tests.support.atlas_scenes import field

DIRECTIONS = fibonacci(100)


@pytest.mark.data
@pytest.mark.parametrize(
    ("fault", "mae", "mse"), [(True, 13.173309733, 508.4909367), (False, 2.5245353190, 29.9604012)]
)
def test_the_thesis_own_figures(data: Path, fault: bool, mae: float, mse: float) -> None:
    crop = data / "nerf2mesh" / "crop64"
    atlas = load_folder(crop / "thesis_16x64", nerfbake.BakedAtlas).atlases[0]
    scene = load_folder(crop, nerfbake.Stage1).fields[0]
    error = measure_atlas_error(atlas, scene, directions=DIRECTIONS, lookup="thesis", thesis_fault=fault)
    assert error.mae == pytest.approx(mae, abs=5e-10)
    assert error.mse == pytest.approx(mse, abs=5e-8)


@pytest.mark.data
def test_the_thesis_folder_says_its_sizes_without_results_json(data: Path, tmp_path: Path) -> None:
    folder = data / "nerf2mesh" / "crop64" / "thesis_16x64"
    for name in ("octahedron_maps.png", "labels_map.png"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    told, found = (load_folder(path, nerfbake.BakedAtlas).atlases[0] for path in (folder, tmp_path))
    np.testing.assert_array_equal(found.tiles, told.tiles)
    np.testing.assert_array_equal(found.labels, told.labels)
    (tmp_path / "octahedron_maps.png").write_bytes(encode_texture(np.zeros((255, 255, 3), np.uint8)))
    with pytest.raises(InvalidFile, match="has 255x255 texels; allowed: 4x4 maps for 16 labels, or a"):
        load_folder(tmp_path, nerfbake.BakedAtlas)


def test_maps_that_hold_the_outputs_have_hardly_an_error() -> None:
    # A direction at each texel's centre: nothing is interpolated, and only rounding is left.
    scene = field(4, 4)
    colours = len(np.unique(scene.features.reshape(-1, 3), axis=0))
    atlas = bake_atlas(scene, clusters=colours, map_size=8)
    for lookup in ("bilinear", "nearest"):
        error = measure_atlas_error(atlas, scene, directions=octahedron.texel_directions(8), lookup=lookup)
        assert error.mae < 1e-3
        assert 0.2 < error.mae_float < 0.3  # a quarter, as rounding to whole numbers has


def test_the_error_of_black_maps_is_what_the_mlp_shows() -> None:
    scene = field()
    black = OctahedralAtlas("kmeans", np.zeros((1, 4, 4, 3), np.uint8), np.zeros(scene.used.shape, np.uint16))
    error = measure_atlas_error(black, scene, directions=DIRECTIONS)
    features = scene.features.reshape(-1, 3) / 255
    inputs = np.concatenate([np.tile(DIRECTIONS, (len(features), 1)), np.repeat(features, 100, axis=0)], axis=1)
    shown = np.rint(255 / (1 + np.exp(-np.maximum(inputs @ scene.w0, 0) @ scene.w1)))
    assert error.mae == pytest.approx(shown.mean(), rel=1e-4)
    assert error.mse == pytest.approx(np.square(shown).mean(), rel=1e-4)
    assert error.texels == scene.used.sum()


def test_the_fault_only_makes_it_worse() -> None:
    scene = field()
    atlas = bake_atlas(scene, clusters=100, map_size=32)
    right, wrong = (
        measure_atlas_error(atlas, scene, directions=DIRECTIONS, thesis_fault=fault) for fault in (False, True)
    )
    assert wrong.mse > 2 * right.mse


def test_textures_of_two_sizes_are_refused() -> None:
    atlas = bake_atlas(field(), clusters=2, map_size=4)
    with pytest.raises(InvalidScene, match="labels have 32x24 texels; allowed: 20x10"):
        measure_atlas_error(atlas, field(10, 20), directions=DIRECTIONS)
