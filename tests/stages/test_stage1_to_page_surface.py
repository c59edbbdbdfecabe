"""What a page shows of stage 1, of an atlas, and of both."""

from __future__ import annotations

from dataclasses import replace

import pytest

from nerfbake import BakedAtlas, Stage1, bake_stage1, build_page_surface, load, memory_limit
from nerfbake.errors import InvalidScene, MemoryLimit
from tests.support.atlas_scenes import field, stage1_folder
from tests.support.meshes import painted


@pytest.fixture(scope="module")
def stage1(tmp_path_factory: pytest.TempPathFactory) -> Stage1:
    return load(stage1_folder(tmp_path_factory.mktemp("stage1") / "a"), Stage1)


@pytest.fixture(scope="module")
def atlas(stage1: Stage1) -> BakedAtlas:
    return bake_stage1(stage1, clusters=4, map_size=8)


def test_a_page_offers_what_there_is(stage1: Stage1, atlas: BakedAtlas) -> None:
    assert build_page_surface(stage1).highlights == ("mlp_constants", "mlp_textures")
    assert build_page_surface(atlas).highlights == ("kmeans",)
    assert build_page_surface(atlas, stage1=stage1).highlights == ("kmeans", "mlp_constants", "mlp_textures")


def test_an_atlas_of_another_scene_is_refused(stage1: Stage1, atlas: BakedAtlas) -> None:
    other = replace(stage1, fields=(field(16, 16),))
    with pytest.raises(InvalidScene, match="the atlas has 1 textures of 32x24 labels; allowed: 1 of 16x16"):
        build_page_surface(atlas, stage1=other)


def test_without_a_mesh_there_is_nothing_to_see(stage1: Stage1) -> None:
    with pytest.raises(InvalidScene, match=r"mesh_0\.obj is missing"):
        build_page_surface(replace(stage1, meshes=(None,)))


def test_parts_that_do_not_fit_are_refused(stage1: Stage1) -> None:
    surface = build_page_surface(stage1)
    with pytest.raises(InvalidScene, match="the feature textures are 2; allowed: 1, one for each mesh"):
        replace(surface, fields=surface.fields * 2)


def test_plain_meshes_have_no_highlights() -> None:
    surface = build_page_surface(painted())
    assert (len(surface.meshes), surface.highlights) == (3, ())
    assert str(surface) == "26 triangles"


def test_a_surface_asks_for_the_memory_of_its_page(stage1: Stage1) -> None:
    with memory_limit(1 << 12), pytest.raises(MemoryLimit, match="the page's triangles and textures"):
        build_page_surface(stage1)
