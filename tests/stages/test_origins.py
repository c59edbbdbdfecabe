"""Whether the positions of a scene are known in the world of an origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake import Meshes
from nerfbake.stages.origins import has_origin, origin_of
from tests.support.meshes import cube
from tests.support.scenes import n3tree
from tests.support.splats import ball_of_splats

UTM = np.array([453000.125, 5012345.5, 120.25])


def test_scenes_that_lie_where_the_origin_is_have_not_lost_it() -> None:
    ball, mesh = ball_of_splats(20), Meshes((cube(),))
    for near in (ball, mesh):
        assert not has_origin(near, UTM)
        assert has_origin(replace(near, origin=UTM + 1000), UTM)
    # In float32, but in the same world.
    assert has_origin(replace(mesh, meshes=mesh.relative_to(-UTM).meshes), UTM)
    assert has_origin(replace(ball, means=ball.relative_to(-UTM).means), UTM)


def test_other_scenes_have_none() -> None:
    assert origin_of(n3tree()).tolist() == [0, 0, 0]
    assert not has_origin(n3tree(), UTM)
    assert origin_of(Meshes((cube(),), origin=UTM)).tolist() == UTM.tolist()
