"""The real chair: what the files' own description says of them, and every voxel against the tree."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import build_octree, cut_octree, load, save, summarise_scene
from nerfbake.formats.octree.svoq import coded_size
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import Layout, SparseVoxelOctree
from nerfbake.scene.volume import Volume
from nerfbake.stages.coefficients import transform, visible_leaves
from tests.conftest import DATA, Shell
from tests.support.scenes import assert_same_octree, world_centres

pytestmark = [pytest.mark.data, pytest.mark.long]

# nodes, leaves that hold something: as the data's README has them
FILES = {
    "chair_sh9": (117_491, 524_883, "svox"),
    "chair_sh9_128": (24_886, 137_542, "svox"),
    "chair_sh9_128_legacy": (24_886, 137_542, "legacy"),
    "chair_sh9_128_fragmented": (25_881, 116_640, "svox"),
    "chair_sh9_128_quant": (24_886, 117_658, "quantised"),
    "chair_sh9_128_quant_retain1": (24_886, 117_658, "quantised+retained"),
}


def file(name: str) -> Path:
    return DATA / "plenoctree" / "chair" / f"{name}.npz"


@cache
def chair(name: str) -> N3Tree:
    return load(file(name), N3Tree)


@pytest.mark.parametrize("name", FILES)
def test_figures_of_the_description(name: str) -> None:
    nodes, occupied, dialect = FILES[name]
    facts = summarise_scene(chair(name))
    assert facts["nodes"] + facts["freed_rows"] == nodes
    assert facts["occupied_leaves"] == occupied
    assert facts["dialect"] == dialect
    assert facts["data_format"] == "SH9"
    assert chair(name).problems() == []


def test_levels_of_the_description() -> None:
    facts = summarise_scene(chair("chair_sh9"))
    assert facts["nodes_per_level"] == [1, 8, 45, 152, 633, 3207, 18083, 95362]
    # There, leaves are counted by the depth of the node they are cells of; here by their own level, one below.
    assert facts["leaves_per_level"] == [0, 0, 19, 208, 583, 1857, 7573, 49302, 762896]
    assert facts["occupied_per_level"] == [0, 0, 0, 0, 0, 0, 80, 14276, 510527]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("size", [(64, 64, 64), (128, 128, 128), (100, 80, 60)])
@pytest.mark.parametrize("name", FILES)
def test_every_voxel_reads_what_the_tree_reads(name: str, size: tuple[int, int, int]) -> None:
    tree = chair(name)
    octree = build_octree(tree, resolution=size, resample="nearest")
    points = world_centres(octree)
    assert_array_equal(octree.sample(points), tree.sample(points))


@pytest.mark.long
@pytest.mark.slow
def test_every_fifth_plane_at_256_reads_what_the_tree_reads() -> None:
    """Voxels in every place of their parents: 5 is odd."""
    tree = chair("chair_sh9")
    octree = build_octree(tree, resolution=256, resample="nearest")
    for plane in world_centres(octree).reshape(256, -1, 3)[::5]:
        assert_array_equal(octree.sample(plane), tree.sample(plane))
    # At the tree's own resolution there is nothing to average.
    assert_same_octree(octree, build_octree(tree))


@pytest.mark.parametrize(("size", "leaves"), [((100, 80, 60), 35_240), (200, 448_486)])
def test_no_leaf_holds_nothing_at_any_size(size: int | tuple[int, int, int], leaves: int) -> None:
    octree = build_octree(chair("chair_sh9"), resolution=size)
    assert (octree.sigma > 0).all()
    assert np.count_nonzero(octree.childless) == leaves


def test_spellings_of_one_tree_give_one_octree() -> None:
    for resolution in (128, 64):
        plain, legacy = (build_octree(chair(name), resolution=resolution) for name in list(FILES)[1:3])
        assert_same_octree(plain, legacy)


def test_the_fragmented_tree_is_the_plain_one_with_some_nodes_averaged() -> None:
    # svox's merge replaced 3,981 nodes by the float16 mean of their cells before it freed their rows: its octree is the
    # plain one everywhere else, and holds one leaf for eight there.
    plain, fragmented = (build_octree(chair(f"chair_sh9_128{end}"), resolution=128) for end in ("", "_fragmented"))
    points = world_centres(plain).reshape(64, 2, 64, 2, 64, 2, 3).transpose(0, 2, 4, 1, 3, 5, 6).reshape(-1, 8, 3)
    a, b = plain.sample(points), fragmented.sample(points)
    differ = (a != b).any(axis=(1, 2))
    assert differ.sum() == 3981 == summarise_scene(chair("chair_sh9_128_fragmented"))["freed_rows"]
    assert_array_equal(b[differ], np.broadcast_to(b[differ][:, :1], b[differ].shape))
    np.testing.assert_allclose(b[differ][:, 0], a[differ].mean(axis=1), rtol=1e-3, atol=2e-4)


@pytest.mark.parametrize("retained", [0, 1])
def test_quantised_values_are_decoded_exactly(retained: int) -> None:
    name = "chair_sh9_128_quant" + "_retain1" * retained
    tree = chair(name)
    with np.load(file(name)) as npz:
        colors, codes, sigma = npz["quant_colors"], npz["quant_map"], npz["sigma"]
        kept = npz["data_retained"] if retained else None
    assert_array_equal(tree.data[..., 27], sigma)
    for i in range(9):
        rgb = kept[i] if kept is not None and i < retained else colors[i - retained][codes[i - retained]]
        for channel in range(3):
            assert_array_equal(tree.data[..., 9 * channel + i], rgb[..., channel])


def test_a_cut_shows_what_a_bake_at_half_the_resolution_holds() -> None:
    tree = chair("chair_sh9")
    cut, direct = cut_octree(build_octree(tree), level=7), build_octree(tree, resolution=128)
    assert cut.size == direct.size
    assert_array_equal(cut.node_children, direct.node_children)
    np.testing.assert_allclose(cut.node_data, direct.node_data, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("suffix", [".svo.pb", ".svo.npz"])
@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_files_hold_the_octree_bit_for_bit(suffix: str, dtype: str, tmp_path: Path) -> None:
    octree = build_octree(chair("chair_sh9_128"), dtype=dtype)  # type: ignore[arg-type]
    layouts: tuple[Layout, ...] = ("full", "compact")
    for layout in layouts:
        there = octree.with_layout(layout)
        save(tmp_path / f"a{suffix}", there, force=True)
        back = load(tmp_path / f"a{suffix}", SparseVoxelOctree)
        assert_same_octree(back, there)
        assert_same_octree(back.with_layout("full"), octree)


def test_the_chair_comes_back_to_the_bit(shell: Shell, tmp_path: Path) -> None:
    source = str(file("chair_sh9_128"))
    assert shell("svo", source, "a.svo.npz").returncode == 0
    octree = load(tmp_path / "a.svo.npz", SparseVoxelOctree)
    for out, options in (("a.nvdb", ["--grids", "index"]), ("a.vdb", ["--grids", "density,sh"])):
        assert shell("vdb", source, out, *options).returncode == 0
        assert shell("convert", out, "b.svo.npz", "--force").returncode == 0
        assert_same_octree(load(tmp_path / "b.svo.npz", SparseVoxelOctree), octree)


def test_the_table_is_nearly_all_of_an_index_file(shell: Shell, tmp_path: Path) -> None:
    source = str(file("chair_sh9"))
    assert shell("vdb", source, "a.nvdb", "--grids", "index", "--half").returncode == 0
    (grid,) = load(tmp_path / "a.nvdb", Volume).grids
    assert grid.values.shape == (629_855, 28)
    assert grid.values.nbytes > 0.95 * (tmp_path / "a.nvdb").stat().st_size


@pytest.mark.parametrize(("name", "away"), [("chair_sh9", 0.06), ("chair_sh9_128", 0.2)])
def test_sizes_are_estimated_without_coding(name: str, away: float) -> None:
    octree = build_octree(chair(name))
    rows = visible_leaves(octree)
    made = transform(octree, rows, octree.leaf_values(rows), np.arange(len(rows)), np.eye(9) / (4 * np.pi))
    for step in (0.06, 0.24):
        size = made.estimated_size(step)
        assert size == pytest.approx(coded_size(made.rounded(step)), rel=away)
        assert made.step_for_size(size) == pytest.approx(step, rel=0.01)
