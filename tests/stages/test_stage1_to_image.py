"""nerf2mesh's stage 1 and its atlas as pictures: what their viewers show."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import (
    BakedAtlas,
    Stage1,
    bake_stage1,
    colour_meshes,
    compare_scenes,
    orbit_cameras,
    render_meshes,
    render_stage1,
    sample_stage1,
)
from nerfbake.errors import InvalidScene
from nerfbake.formats.mesh import mobilenerf
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface.mlp import evaluate
from nerfbake.scene.atlas import METHODS, Method
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.stages.stage1_to_image import surfaces
from tests.support.atlas_scenes import field, looked_up, random_atlas, texture
from tests.support.meshes import square, straight_down
from tests.support.mobilenerf_scenes import phone_files, picture

BLACK = np.zeros((2, 2, 3), np.uint8)


def flat(diffuse: npt.NDArray[np.uint8]) -> Mesh:
    """A square that fills the picture of a straight_down() camera as wide as its focal length."""
    return replace(square(half=1.0), texture=diffuse)


@pytest.mark.parametrize("method", METHODS)
def test_the_atlas_is_shown_as_the_shader_shows_it(method: Method) -> None:
    atlas = random_atlas(method, border=1)
    H, W = atlas.labels.shape
    N = 28  # pixels an edge; none of their centres is on an edge between two texels
    view = straight_down(N, N, float(N))
    image = render_stage1(BakedAtlas((atlas,), (flat(BLACK),), {}, {}), view)
    row, column = (((np.arange(N) + 0.5) / N * size).astype(int) for size in (H, W))
    texels = (row[:, None] * W + column).reshape(-1)
    seen = np.empty((N * N, 3))
    for part in np.array_split(np.arange(N * N), 8):  # the twin shows every map in every direction
        seen[part] = looked_up(atlas, texels[part], view.rays()[1][part])
    np.testing.assert_allclose(image.colour.reshape(-1, 3), np.clip(seen, 0, 1), atol=2e-5)


def test_the_mlp_is_evaluated_in_the_rays_direction() -> None:
    specular = field(32, 32)
    view = straight_down(32, 32, 32.0)
    image = render_stage1(Stage1((specular,), (flat(BLACK),)), view)
    directions = view.rays()[1]
    each = evaluate(specular.features.reshape(-1, 3) / 255, directions, specular.w0, specular.w1)
    shown = each[np.arange(32 * 32), :, np.arange(32 * 32)]
    np.testing.assert_allclose(image.colour.reshape(-1, 3), shown, atol=1e-5)


def test_the_diffuse_colour_is_added_and_the_sum_cut() -> None:
    specular, diffuse = field(32, 32), texture(32, 32)
    view = straight_down(32, 32, 32.0)
    alone = render_stage1(Stage1((specular,), (flat(BLACK),)), view).colour
    both = render_stage1(Stage1((specular,), (flat(diffuse),)), view).colour
    np.testing.assert_allclose(both, np.minimum(alone + diffuse / 255, 1), atol=1e-5)
    assert (both == 1).any()


@pytest.fixture(scope="module")
def sample() -> Stage1:
    return sample_stage1(resolution=128)


def test_more_maps_are_closer_in_pictures_too(sample: Stage1) -> None:
    views = orbit_cameras(sample, frames=3, width=96, height=96)

    def quality(**options: Any) -> float:
        return float(compare_scenes(sample, bake_stage1(sample, **options), views).means["a_b"]["psnr"])

    found = [quality(clusters=1), quality(clusters=16), quality(clusters=64, method="affine")]
    assert found == sorted(found)
    assert found[0] > 25
    assert found[-1] > found[0] + 5


def test_the_orbit_has_z_up_as_nerf2meshs_viewer(sample: Stage1) -> None:
    (view,) = orbit_cameras(sample, width=96, height=96).cameras
    assert view.pose[2, 1] > 0.8
    assert abs(view.pose[2, 0]) < 1e-12
    alpha = render_stage1(sample, view).alpha
    assert alpha.any()
    assert not alpha[[0, -1]].any()


def test_two_cascades_have_an_atlas_each(sample: Stage1) -> None:
    (mesh,), (first,) = surfaces(sample), sample.fields
    raised = replace(mesh, positions=mesh.positions + np.array([0, 1, 0], np.float32))
    other = replace(first, features=255 - first.features)
    both = Stage1((first, other), (mesh, raised))
    (view,) = orbit_cameras(both, width=64, height=64).cameras
    together = render_stage1(both, view)
    lower = render_meshes(Meshes((raised,)), view).alpha == 0
    one, two = (render_stage1(Stage1((f,), (m,)), view).colour for f, m in ((first, mesh), (other, raised)))
    np.testing.assert_array_equal(together.colour[lower], one[lower])
    hidden = render_meshes(Meshes((mesh,)), view).alpha == 0
    np.testing.assert_array_equal(together.colour[hidden], two[hidden])
    assert (together.colour[~lower] != one[~lower]).any()


def test_without_a_mesh_there_is_no_picture(sample: Stage1) -> None:
    (mesh,) = surfaces(sample)
    for meshes, named in (((None,), r"mesh_0\.obj is missing"), ((replace(mesh, texture=None),), "feat0_0 is missing")):
        with pytest.raises(InvalidScene, match=named):
            orbit_cameras(replace(sample, meshes=meshes))


# -- MobileNeRF --------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def phone() -> Stage1:
    return mobilenerf.decode({name: memoryview(data) for name, data in phone_files().items()})


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_mobilenerf_s_pictures_are_those_of_its_viewer(phone: Stage1, samples: int) -> None:
    """Features, directions and holes, averaged before the MLP; a few rays meet another texel by rounding."""
    for camera in orbit_cameras(phone, frames=3, width=40, height=30).cameras:
        wanted, alpha = picture(camera, samples)
        made = render_stage1(phone, camera, samples=samples)
        right = np.abs(made.colour - wanted).max(axis=2) < 3e-6
        assert right.mean() > 0.998
        np.testing.assert_allclose(made.alpha[right], alpha[right], atol=1e-6)
        assert 0.02 < (alpha > 0).mean() < 0.9
        clear = render_stage1(phone, camera, samples=samples, background=None)
        np.testing.assert_allclose(clear.over((1, 1, 1)).colour, made.colour, atol=1e-6)


def test_averages_of_features_are_not_averages_of_colours(phone: Stage1) -> None:
    (camera,) = orbit_cameras(phone, width=40, height=40).cameras
    (fine,) = orbit_cameras(phone, width=80, height=80).cameras
    colours = render_stage1(phone, fine).colour.reshape(40, 2, 40, 2, 3).mean(axis=(1, 3))
    assert np.abs(render_stage1(phone, camera, samples=2).colour - colours).max() > 0.05


def test_an_atlas_of_mobilenerf_has_its_holes(phone: Stage1) -> None:
    atlas = bake_stage1(phone, clusters=598, map_size=32)
    for camera in orbit_cameras(phone, frames=2, width=60, height=60).cameras:
        shown, wanted = render_stage1(atlas, camera), render_stage1(phone, camera)
        np.testing.assert_array_equal(shown.alpha, wanted.alpha)
        assert np.abs(shown.colour - wanted.colour)[wanted.alpha > 0].mean() < 0.02


def test_a_mesh_of_mobilenerf_has_the_mean_colour(phone: Stage1) -> None:
    [field], [mesh] = phone.fields, colour_meshes(phone, directions=20).meshes
    means = evaluate(field.features[field.used] / 255, fibonacci(20), *field.mlp).mean(axis=2)
    assert mesh.texture is not None
    assert np.abs(mesh.texture[field.used] / 255 - means).max() < 0.5001 / 255 + 1e-6
