"""HTML pages for tests, and a check that they show the same pictures as `nerfbake render`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import (
    Page,
    PageField,
    RadianceField,
    SparseVoxelOctree,
    build_field,
    build_octree,
    build_page_field,
    orbit_cameras,
    quantise_octree,
    render_field,
    round_field,
    sample_n3tree,
    save,
    scatter_cameras,
    weigh_leaves,
)
from nerfbake.scene.octree import Lookup
from tests.support.browser import Seen

EDGE = 200


class Made(NamedTuple):
    """The file of a page, the field that it shows, and the arrays that its shader should receive."""

    path: Path
    field: RadianceField
    arrays: PageField


def exact_page(path: Path, field: RadianceField, title: str = "A page", *, lookup: Lookup = "nearest") -> Made:
    arrays = build_page_field(field)
    save(path, replace(view_of(arrays, field, title), lookup=lookup))
    return Made(path, round_field(field), arrays)


def compressed_page(path: Path, octree: SparseVoxelOctree) -> Made:
    """A page with a compressed octree. `arrays` are the decoded ones, before coefficients are rounded to bytes."""
    field = build_field(octree)
    importance = weigh_leaves(field, scatter_cameras(field, frames=4, edge=32))
    quantised = quantise_octree(octree, importance, step=0.05, prune=0.1)
    save(path, view_of(quantised, field))
    shown = replace(build_field(quantised.restored()), box=field.box)
    return Made(path, round_field(shown), build_page_field(shown))


def view_of(content: object, field: RadianceField, title: str = "A page") -> Page:
    cameras = orbit_cameras(field, width=40, height=40)
    return Page(content, field, cameras, render_field(field, cameras.cameras[0]), title)  # type: ignore[arg-type]


def anisotropic() -> RadianceField:
    """SH16 in float32, over a box with unequal edges, away from the world origin."""
    octree = build_octree(sample_n3tree(resolution=32, basis="SH16"), resolution=(24, 32, 17))
    random = np.random.default_rng(0).normal(1, 0.01, octree.node_data.shape)
    values = (octree.node_data * random).astype(np.float32)
    return build_field(replace(octree, node_data=values, voxel_size=np.array([0.1, 0.05, 0.2]), origin=np.full(3, 5.0)))


def assert_same_pictures(page: Seen, field: RadianceField, *, frames: int = 2, lookup: Lookup = "nearest") -> None:
    """Assert that each view has at least 80 dB, and that at most 0.01 % of the channels differ by more than 1."""
    for camera in orbit_cameras(field, frames=frames, width=EDGE, height=EDGE).cameras:
        wanted = render_field(field, camera, lookup=lookup).pixels.astype(np.float64)
        found = page.pixels(camera, smoothly=lookup == "trilinear").astype(np.float64)
        assert (np.abs(found - wanted) > 1).mean() <= 1e-4
        assert decibels(found, wanted) >= 80


def decibels(found: npt.NDArray[np.float64], wanted: npt.NDArray[np.float64]) -> float:
    """The PSNR of two pictures with values from 0 to 255."""
    return float(-10 * np.log10(max(((found - wanted) ** 2).mean() / 255**2, 1e-10)))
