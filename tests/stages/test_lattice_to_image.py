"""Pictures of a lattice: a fog by hand, the background, and what a ray may not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Camera, render_lattice
from nerfbake.errors import InvalidScene
from nerfbake.formats.field import svox2 as reader
from nerfbake.scene.lattice_field import LatticeField, ShColour
from tests.support.lattices import CENTRE, RADIUS, some_lattice, svox2, svox2_file


def ahead(lattice: LatticeField) -> Camera:
    """Above the box's middle, looking along -z through its whole depth; one pixel."""
    pose = np.eye(4)
    pose[:3, 3] = CENTRE + np.array([0, 0, 3])
    return Camera(1, 1, 1e6, pose, "ahead")


def test_a_fog_is_as_thick_as_its_samples() -> None:
    lattice = some_lattice(raw=2.0, features=np.full((210, 3), np.log(0.25 / 0.75), np.float32))
    image = render_lattice(lattice, ahead(lattice), transmittance_cut=0)
    count = np.ceil(2 * RADIUS[2] / lattice.step - 1e-6)
    alpha = 1 - np.exp(-2 * lattice.step * count)
    assert_allclose(image.alpha[0, 0], alpha, rtol=1e-5)
    assert_allclose(image.colour[0, 0], 0.25 * alpha + 1 - alpha, rtol=1e-5)
    bare = render_lattice(lattice, ahead(lattice), background=None, transmittance_cut=0)
    assert_allclose(bare.colour[0, 0], 0.25 * alpha, rtol=1e-5)
    assert 3 - RADIUS[2] < image.depth[0, 0] < 3


def test_colours_are_seen_in_the_rays_own_direction() -> None:
    arrays = svox2(size=4)
    arrays["sh_data"][:] = 0
    arrays["sh_data"][:, 2] = 0.5  # red grows with z
    lattice = reader.decode(memoryview(svox2_file(arrays)))
    image = render_lattice(lattice, ahead(lattice), background=None, transmittance_cut=0)
    red, green, _ = image.colour[0, 0] / image.alpha[0, 0]
    assert_allclose((red, green), (0.5 - 0.48860251 * 0.5, 0.5), rtol=1e-4)


def test_what_is_brighter_than_white_is_white() -> None:
    lattice = some_lattice(raw=500.0, colour=ShColour(1), features=np.full((210, 3), 9.0, np.float32))
    assert_allclose(render_lattice(lattice, ahead(lattice)).colour, 1)


def test_chunks_of_rays_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    from nerfbake.stages import lattice_to_image

    lattice = some_lattice()
    camera = replace(ahead(lattice), width=7, height=5, focal=(9.0, 9.0), centre=(3.5, 2.5))
    whole = render_lattice(lattice, camera, samples=2)
    monkeypatch.setattr(lattice_to_image, "_RAYS", 3)
    parts = render_lattice(lattice, camera, samples=2)
    assert whole.colour.tobytes() == parts.colour.tobytes()


def test_a_cut_of_1_is_refused() -> None:
    with pytest.raises(InvalidScene, match="transmittance_cut is 1"):
        render_lattice(some_lattice(), ahead(some_lattice()), transmittance_cut=1.0)
