from __future__ import annotations

import pytest

from nerfbake import (
    QuantisedOctree,
    build_field,
    build_octree,
    build_page_field,
    quantise_octree,
    sample_n3tree,
    scatter_cameras,
    view,
    weigh_leaves,
)
from nerfbake.errors import UsageError
from nerfbake.scene.page import PageField
from nerfbake.scene.page_splats import PageSplats
from tests.support.splats import ball_of_splats


def test_trees_octrees_and_fields_carry_what_the_shader_reads() -> None:
    tree = sample_n3tree(resolution=16)
    wanted = build_page_field(build_field(tree))
    for scene in (tree, build_octree(tree), build_field(tree)):
        page = view(scene, title="A sample")
        assert isinstance(page.content, PageField)
        assert page.content.texels.tobytes() == wanted.texels.tobytes()
        assert (page.title, page.cover.size) == ("A sample", (320, 320))
        assert page.cover.alpha.max() > 0.5


def test_a_compressed_octree_is_carried_as_it_is() -> None:
    octree = build_octree(sample_n3tree(resolution=16))
    field = build_field(octree)
    importance = weigh_leaves(field, scatter_cameras(field, frames=4, edge=32))
    quantised = quantise_octree(octree, importance, step=0.2)
    page = view(quantised)
    assert isinstance(page.content, QuantisedOctree)
    assert page.content is quantised
    assert page.field is not None
    assert len(page.field.values) > 0


def test_splats_are_drawn_as_splats() -> None:
    page = view(ball_of_splats(), title="A ball")
    assert isinstance(page.content, PageSplats)
    assert page.content.n == ball_of_splats().n
    assert page.cover.alpha.max() > 0.5
    frame = page._repr_html_()
    assert frame is not None
    assert "&quot;kind&quot;:&quot;splats&quot;" in frame.replace(": ", ":")


def test_what_has_no_field_is_refused() -> None:
    with pytest.raises(UsageError, match="has no radiance field"):
        view("chair.npz")  # type: ignore[arg-type]
