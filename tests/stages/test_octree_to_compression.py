from __future__ import annotations

import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nerfbake.errors import BudgetMissed, InvalidScene
from nerfbake.kernels.maths.elementary import log
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import Cameras
from nerfbake.scene.compression import Compression
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.image import Image
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.stages.coefficients import STEPS, transform, visible_leaves
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.field_to_importance import weigh_leaves
from nerfbake.stages.loss import measuring_judge, predicting_judge
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.octree_to_compression import compress_octree, next_step, quantise_octree
from nerfbake.stages.scene_to_cameras import orbit_cameras, scatter_cameras
from nerfbake.stages.scene_to_field import build_field_from_octree
from nerfbake.stages.shapes_to_n3tree import sample_n3tree
from tests.support.scenes import n3tree


def coded_size(quantised: QuantisedOctree) -> int:
    """A coder that needs none of ours."""
    return len(zlib.compress(quantised.values.T.tobytes())) + len(zlib.compress(quantised.masks.tobytes()))


@pytest.fixture(scope="module")
def octree() -> SparseVoxelOctree:
    return build_octree(sample_n3tree(resolution=32, basis="SH4"))


pytestmark = pytest.mark.usefixtures("fewer_rays")


def compressed(octree: SparseVoxelOctree, **options: Any) -> Compression:
    return compress_octree(octree, coded_size=coded_size, **options)


def noisy(octree: SparseVoxelOctree, noise: float, *, samples: int = 1) -> tuple[Cameras, list[Image]]:
    """Photographs that the octree comes near to, but not quite."""
    field = build_field_from_octree(octree)
    cameras = orbit_cameras(field, frames=5, width=60, height=50).chosen(samples=samples)
    random = np.random.default_rng(0)
    images = [render_field(field, camera, samples=samples) for camera in cameras.cameras]
    photographs = [
        Image((image.colour + random.normal(0, noise, image.colour.shape)).astype(np.float32), image.alpha, image.depth)
        for image in images
    ]
    return cameras, photographs


@pytest.mark.parametrize("most", [0.05, 0.1, 1.0])
def test_a_loss_is_kept_and_nearly_used(octree: SparseVoxelOctree, most: float) -> None:
    found = compressed(octree, max_loss=most)
    assert 0.9 * most <= found.loss <= most
    assert not found.measured
    assert found.size == coded_size(found.quantised)


def test_only_the_result_of_a_search_for_a_loss_is_coded(octree: SparseVoxelOctree) -> None:
    coded: list[float] = []

    def coded_once(quantised: QuantisedOctree) -> int:
        coded.append(quantised.colour_step)
        return 1

    found = compress_octree(octree, coded_size=coded_once, max_loss=0.1)
    assert coded == [found.quantised.colour_step]


def test_a_loss_is_given_up_after_one_trial_where_the_size_is_far_off(octree: SparseVoxelOctree) -> None:
    coded: list[float] = []
    tried: list[str] = []

    def size(quantised: QuantisedOctree) -> int:
        coded.append(quantised.colour_step)
        return coded_size(quantised)

    found = compress_octree(octree, coded_size=size, max_loss=0.05, max_size=3_000, tell=tried.append)
    first = float(tried[1].removeprefix("step ").split(",")[0])  # after a line about the leaves
    assert found.size <= 3_000
    assert min(coded) > 3 * first


def test_more_loss_is_fewer_bytes(octree: SparseVoxelOctree) -> None:
    assert compressed(octree, max_loss=0.5).size < 0.8 * compressed(octree, max_loss=0.1).size


@pytest.mark.parametrize("step", [0.03, 0.4])
def test_a_trial_has_the_bits_of_the_octree_that_would_be_written(octree: SparseVoxelOctree, step: float) -> None:
    rows = visible_leaves(octree)
    keep = np.flatnonzero(np.random.default_rng(0).random(len(rows)) < 0.8)
    gram = np.diag(np.linspace(1, 0.3, octree.data_dim // 3))
    made = transform(octree, rows, octree.leaf_values(rows), keep, gram)
    assert made.leaf_values(step).tobytes() == made.rounded(step).leaf_values().tobytes()


def test_the_loss_is_that_of_the_octree_that_comes_back(octree: SparseVoxelOctree) -> None:
    found = compressed(octree, max_loss=0.1)
    judge = predicting_judge(build_field_from_octree(octree))
    cost = judge.cost(build_field_from_octree(found.quantised.restored()))
    assert cost.error == pytest.approx(found.error, rel=1e-6)
    # 30.5 dB, with a margin for the loss.
    assert found.expected == pytest.approx(10 * float(log(1 + cost.error / 10**-3.05)) / np.log(10), rel=1e-6)
    assert found.loss == pytest.approx(10 * float(log(1 + 3.5 * cost.error / 10**-3.05)) / np.log(10), rel=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_promise_is_kept_where_the_original_already_lacks_what_rounding_removes(
    octree: SparseVoxelOctree, share: float
) -> None:
    own = build_field_from_octree(octree)
    importance = weigh_leaves(own, scatter_cameras(own, frames=8, edge=64))
    rounded = build_field_from_octree(quantise_octree(octree, importance, step=0.1).restored())
    promised = predicting_judge(own, source_psnr=30.0).cost(rounded)
    cameras, truth = noisy(octree, 10**-1.5)  # 30 dB
    before, after = [], []
    for camera, image in zip(cameras.cameras, truth, strict=True):
        one, other = (render_field(field, camera).colour.astype(np.float64) for field in (own, rounded))
        # The original's error has half the error of rounding in it, so their covariance doubles what rounding adds.
        photograph = image.colour - share * (other - one)
        before.append(psnr(one, photograph))
        after.append(psnr(other, photograph))
    loss = np.mean(before) - np.mean(after)
    assert np.mean(before) == pytest.approx(30.0, abs=0.05)
    assert 0 < loss <= promised.loss


@pytest.mark.parametrize("most", [3_000, 6_000, 15_000])
def test_a_size_is_never_exceeded_and_nearly_used(octree: SparseVoxelOctree, most: int) -> None:
    found = compressed(octree, max_size=most)
    assert 0.95 * most <= found.size <= most


def test_a_loss_gives_way_to_a_size_where_both_are_given(octree: SparseVoxelOctree) -> None:
    free = compressed(octree, max_loss=0.1)
    assert compressed(octree, max_loss=0.1, max_size=free.size).facts == free.facts
    tight = compressed(octree, max_loss=0.1, max_size=free.size // 2)
    assert 0.9 * (free.size // 2) <= tight.size <= free.size // 2  # larger ones that were tried lose more
    assert tight.loss > 0.1


def test_a_size_that_cannot_be_reached_is_told(octree: SparseVoxelOctree) -> None:
    with pytest.raises(BudgetMissed, match=r"at least [\d,]+ bytes, and `max_size` is 50; allowed: a larger"):
        compressed(octree, max_size=50)


def test_a_huge_size_ends_at_the_finest_step(octree: SparseVoxelOctree) -> None:
    found = compressed(octree, max_size=10**9)
    assert found.quantised.colour_step == STEPS[0]
    assert found.loss < 0.001


def test_a_step_is_taken_as_it_is(octree: SparseVoxelOctree) -> None:
    found = compressed(octree, step=0.07)
    assert found.quantised.colour_step == 0.07


def test_a_loss_is_measured_where_there_are_photographs(octree: SparseVoxelOctree) -> None:
    cameras, truth = noisy(octree, 0.02)
    found = compressed(octree, max_loss=0.2, held_out=HeldOut.of_images(cameras, truth))
    judge = measuring_judge(build_field_from_octree(octree), HeldOut.of_images(cameras, truth))
    assert found.measured
    assert found.views == 5
    assert found.source_psnr == pytest.approx(judge.source_psnr)
    assert found.loss == pytest.approx(judge.cost(build_field_from_octree(found.quantised.restored())).loss, abs=1e-6)
    assert 0.15 <= found.loss <= 0.2


def test_independent_errors_cost_what_is_predicted(octree: SparseVoxelOctree) -> None:
    # Noise has nothing to do with what rounding does, which is what the formula takes for granted.
    cameras, truth = noisy(octree, 0.03)
    found = compressed(octree, step=0.2, held_out=HeldOut.of_images(cameras, truth))
    judge = measuring_judge(build_field_from_octree(octree), HeldOut.of_images(cameras, truth))
    assert found.loss == pytest.approx(10 * np.log10(1 + found.error / judge.source_error), rel=0.15)


@pytest.mark.parametrize(("samples", "rays"), [(1, 1_000), (2, 4_000)])
def test_every_kth_pixel_is_seen_as_in_the_whole_picture(
    octree: SparseVoxelOctree, monkeypatch: pytest.MonkeyPatch, samples: int, rays: int
) -> None:
    monkeypatch.setattr("nerfbake.scene.held_out.RAYS", rays)
    cameras, truth = noisy(octree, 0.0, samples=samples)
    # Photographs without noise: every pixel that is looked at must be the one of the photograph.
    judge = measuring_judge(build_field_from_octree(octree), HeldOut.of_images(cameras, truth))
    assert judge.references[0].shape == (17, 20, 3)
    assert len(judge.cameras[0]) == samples**2
    assert judge.source_psnr > 50  # of 8 bits a channel


def test_pruned_is_the_share_of_the_leaves_that_are_gone(octree: SparseVoxelOctree) -> None:
    data = np.zeros((1, 2, 2, 2, 4), np.float16)
    data[0, 0, 0, 0] = 5
    alone = build_octree(n3tree(data=data))
    assert compressed(alone, step=0.1).pruned == 0
    found = compressed(octree, step=0.1)
    assert found.pruned == 1 - found.quantised.m / len(visible_leaves(octree))


def test_a_lower_basis_is_part_of_the_loss(octree: SparseVoxelOctree) -> None:
    found = compressed(octree, step=0.01, basis="SH1")
    assert found.quantised.data_format == "SH1"
    assert found.loss > compressed(octree, step=0.01).loss


def test_a_basis_that_cannot_be_is_told_before_the_work(
    octree: SparseVoxelOctree, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfbake.stages.octree_to_compression.weigh_leaves", None)
    with pytest.raises(InvalidScene, match=r"^the basis is SH3 for an octree of SH\d+; allowed: SH1"):
        compressed(octree, step=0.01, basis="SH3")


def test_a_basis_that_loses_too_much_is_told(octree: SparseVoxelOctree) -> None:
    with pytest.raises(BudgetMissed, match="at the finest step"):
        compressed(octree, max_loss=0.001, basis="SH1")


def test_the_same_octree_is_the_same_file(octree: SparseVoxelOctree) -> None:
    one, other = (compressed(octree, max_loss=0.1) for _ in range(2))
    assert one.facts == other.facts
    assert one.quantised.values.tobytes() == other.quantised.values.tobytes()


@pytest.mark.parametrize("goals", [{}, {"max_loss": 0.1, "step": 0.1}])
def test_one_goal_is_needed(octree: SparseVoxelOctree, goals: dict[str, Any]) -> None:
    with pytest.raises(InvalidScene, match="max_loss, max_size or both, or else step"):
        compressed(octree, **goals)


def test_photographs_of_another_number_are_told(octree: SparseVoxelOctree) -> None:
    cameras, truth = noisy(octree, 0.0)
    with pytest.raises(InvalidScene, match="truth has 4 pictures; allowed: 5"):
        HeldOut.of_images(cameras, truth[:4])


def test_the_next_step_lies_on_the_line() -> None:
    # Loss as the square of the step: 1 at 0.2.
    assert next_step([(0.1, 0.25)], slope=2.0) == pytest.approx(0.2 * np.sqrt(0.985))
    assert next_step([(0.1, 0.25), (0.4, 4.0)], slope=2.0) == pytest.approx(0.2 * np.sqrt(0.985))
    # Sizes fall; a step far off is not trusted further than twice in logarithms.
    assert next_step([(0.1, 1e6)], slope=-0.8) == pytest.approx(0.1 * np.exp(2))
    assert next_step([(STEPS[0], 0.5)], slope=-0.8) == STEPS[0]


def test_a_leaf_far_away_does_not_dilute_the_prediction() -> None:
    """The same object in an eighth of a larger tree, with and without a faint leaf in its far corner."""
    small = sample_n3tree(resolution=16, basis="SH4")
    child = np.concatenate([np.zeros((1, 2, 2, 2), np.int32), small.child])
    child[0, 0, 0, 0] = 1
    data = np.concatenate([np.zeros((1, *small.data.shape[1:]), small.data.dtype), small.data])
    alone = replace(small, child=child, data=data, offset=small.offset / 2, invradius=small.invradius / 2)
    far = replace(alone, data=data.copy())
    far.data[0, 1, 1, 1, -1] = 1e-3
    costs = []
    for tree in (alone, far):
        field = build_field_from_octree(build_octree(tree))
        faded = replace(field, values=field.values * np.float32(0.99))
        costs.append(predicting_judge(field).cost(faded).loss)
    assert costs[1] == pytest.approx(costs[0], rel=0.05)
