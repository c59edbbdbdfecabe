"""Triangles as a page carries them, read back by hand; tests/shaders/test_page_meshes.py reads them in a browser."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import (
    Cameras,
    Mesh,
    Page,
    RadianceField,
    Stage1,
    bake_stage1,
    build_field,
    build_page_field,
    build_page_surface,
    load,
    render_meshes,
    sample_n3tree,
)
from nerfbake.errors import InvalidScene
from nerfbake.formats.page.triangles import pack_triangles, triangle_facts
from tests.support.atlas_scenes import stage1_folder
from tests.support.meshes import cube, painted, straight_down


def page_of(**parts: Any) -> Page:
    """A page with these triangles and nothing else to speak of."""
    cameras = Cameras((straight_down(4, 4),))
    return Page(cover=render_meshes(painted(), cameras.cameras[0]), cameras=cameras, **parts)


@pytest.fixture(scope="module")
def field() -> RadianceField:
    return build_field(sample_n3tree(resolution=8, basis="SH1"))


def beside(field: RadianceField, *meshes: Mesh) -> Page:
    return page_of(content=build_page_field(field), field=field, meshes=meshes)


def test_a_page_without_triangles_says_nothing_of_them(field: RadianceField) -> None:
    assert pack_triangles(beside(field)) == b""
    assert triangle_facts(beside(field), at=7) == {}


def test_numbers_go_as_planes_of_differences(field: RadianceField) -> None:
    positions = np.array([[1, 0, 2], [1, 3, 2], [-1, 3, 2]], np.float32)
    mesh = Mesh(positions, None, np.array([[0, 1, 2]], np.uint32))
    raw = zlib.decompress(pack_triangles(beside(field, mesh)))
    bits = positions.view(np.uint32).T.astype(np.int64)
    steps = np.diff(bits, axis=1, prepend=0) % 2**32
    wanted = b"".join(bytes((steps[axis] >> shift & 255).tolist()) for axis in range(3) for shift in (0, 8, 16, 24))
    assert raw == wanted + bytes([0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0])


def test_the_facts_tell_every_array_of_every_kind_of_mesh(field: RadianceField) -> None:
    page = beside(field, *painted().meshes)
    facts = triangle_facts(page, at=7)["triangles"]
    assert (facts["at"], facts["size"]) == (7, len(zlib.decompress(pack_triangles(page))))
    assert [part["colours"] for part in facts["parts"]] == [False, True, False]
    assert [part["textures"] for part in facts["parts"]] == [{}, {}, {"diffuse": [4, 4]}]
    assert facts["highlights"] == ["none"]
    assert facts["centre"] == [0, 0, 0]
    np.testing.assert_allclose(triangle_facts(beside(field, cube(0.5)), at=0)["triangles"]["reach"], np.sqrt(0.75))


def test_the_facts_tell_what_the_shader_asks_of_an_atlas(tmp_path: Path) -> None:
    stage1 = load(stage1_folder(tmp_path / "a"), Stage1)
    atlas = bake_stage1(stage1, method="affine", clusters=4, map_size=8)
    page = page_of(content=build_page_surface(atlas, stage1=stage1), field=None)
    facts = triangle_facts(page, at=0)["triangles"]
    [part] = facts["parts"]
    assert set(part["textures"]) == {"diffuse", "atlas", "labels", "atlasFeatures", "mlpFeatures"}
    slope = atlas.atlases[0].slope
    assert part["atlas"] == {"mapSize": 8.0, "border": 1.0, "tilesPerRow": 4.0, "slope": slope}
    assert facts["hidden"] == 8


def test_meshes_stand_beside_a_field_and_not_beside_a_surface(tmp_path: Path, field: RadianceField) -> None:
    surface = build_page_surface(load(stage1_folder(tmp_path / "a"), Stage1))
    with pytest.raises(InvalidScene, match="the meshes are combined with a surface"):
        page_of(content=surface, field=None, meshes=(cube(),))
    with pytest.raises(InvalidScene, match="the field is present; allowed: a field for voxels"):
        page_of(content=surface, field=field)
