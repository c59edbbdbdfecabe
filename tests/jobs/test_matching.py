"""Matches of features, and the pairs of pictures that are matched."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.jobs._matching import (
    LARGEST,
    NEIGHBOURS,
    PARTNERS,
    all_pairs,
    largest,
    likely_pairs,
    match,
    pairs_in_order,
)

Descriptors = npt.NDArray[np.uint8]


def blocks(*numbers: int) -> Descriptors:
    """Descriptors that are at right angles for different numbers, 0 to 7. Their length is 512: 16 times 128 squared."""
    return np.repeat(np.eye(8, dtype=np.uint8)[list(numbers)] * 128, 16, axis=1)


def rounded(values: npt.NDArray[np.float64]) -> Descriptors:
    values = values * (512 / np.linalg.norm(values, axis=1, keepdims=True))
    return np.rint(np.minimum(values, 255)).astype(np.uint8)


def two_pictures(seed: int) -> tuple[Descriptors, Descriptors]:
    """700 and 900 features; every second one of the first is in the second, too, more or less changed."""
    random = np.random.default_rng(seed)
    first, second = random.exponential(1, (700, 128)), random.exponential(1, (900, 128))
    seen = random.permutation(900)[:350]
    share = random.uniform(0, 0.8, (350, 1))
    second[seen] = (1 - share) * first[::2] + share * second[seen]
    return rounded(first), rounded(second)


def matched_by_definition(first: Descriptors, second: Descriptors) -> list[list[int]]:
    """Mutual nearest features within an angle of about 0.7, with a ratio of distances below 0.8 in both directions."""
    products = first.astype(np.int64) @ second.astype(np.int64).T
    squares = np.maximum(512 * 512 - products, 0)
    found = []
    for i, j in enumerate(squares.argmin(axis=1)):
        others = min(np.delete(squares[i], j).min(), np.delete(squares[:, j], i).min())
        if squares[:, j].argmin() == i and products[i, j] >= 0.765 * 512**2 and squares[i, j] < 0.64 * others:
            found.append([i, int(j)])
    return found


def test_equal_features_are_matched() -> None:
    assert match(blocks(3, 0, 5), blocks(0, 1, 2, 3)).tolist() == [[0, 3], [1, 0]]


def test_a_feature_that_is_there_twice_is_not_matched() -> None:
    assert match(blocks(3, 0), blocks(0, 3, 0)).tolist() == [[0, 1]]
    assert match(blocks(0, 3, 0), blocks(3, 0)).tolist() == [[1, 0]]


def test_features_at_a_large_angle_are_not_matched() -> None:
    mixed = blocks(0, 1, 2, 3)
    mixed[0] = (blocks(0)[0] * 0.8 + blocks(7)[0] * 0.6).astype(np.uint8)  # 0.64 from block 0
    assert match(mixed, blocks(0, 1)).tolist() == [[0, 0], [1, 1]]
    mixed[0] = (blocks(0)[0] * 0.7 + blocks(7)[0] * 0.714).astype(np.uint8)  # 0.8
    assert match(mixed, blocks(0, 1)).tolist() == [[1, 1]]


@pytest.mark.parametrize("counts", [(0, 0), (0, 3), (1, 3), (3, 1)])
def test_pictures_with_hardly_any_features_have_no_matches(counts: tuple[int, int]) -> None:
    first, second = (blocks(*range(count)) for count in counts)
    assert match(first, second).shape == (0, 2)


@pytest.mark.parametrize("seed", range(3))
def test_matches_are_those_of_the_definition_and_the_same_in_both_directions(seed: int) -> None:
    first, second = two_pictures(seed)
    found = match(first, second)
    assert 100 < len(found) < 350
    assert found.tolist() == matched_by_definition(first, second)
    assert sorted(map(tuple, match(second, first)[:, ::-1].tolist())) == sorted(map(tuple, found.tolist()))


def test_the_largest_features_are_compared() -> None:
    keypoints = np.zeros((LARGEST + 5, 6), np.float32)
    keypoints[:, 2] = np.arange(LARGEST + 5)  # the scale, times the cosine of the direction
    keypoints[0, 4] = LARGEST + 9  # times its sine
    descriptors = np.repeat((np.arange(LARGEST + 5) % 251)[:, None].astype(np.uint8), 128, axis=1)
    expected = [0, *range(LARGEST + 4, 5, -1)]
    assert largest(keypoints, descriptors).tolist() == descriptors[expected].tolist()
    assert len(largest(keypoints[:9], descriptors[:9])) == 9


def test_pairs_in_order_are_the_next_pictures_and_those_at_powers_of_two() -> None:
    assert all_pairs(5) == pairs_in_order(5)
    assert len(pairs_in_order(18)) == sum(18 - step for step in (*range(1, 11), 16))
    assert (0, 16) in pairs_in_order(18)


def test_likely_pairs_are_those_with_most_in_common_and_the_next_ones() -> None:
    # 100 pictures around an object: the closer, the more they have in common. The last ones are next to the first.
    pairs = all_pairs(100)
    apart = [min(second - first, 100 - second + first) for first, second in pairs]
    found = likely_pairs(100, [500 - 10 * distance for distance in apart])
    assert found == sorted(pair for pair, distance in zip(pairs, apart, strict=True) if distance <= PARTNERS // 2)


def test_pictures_without_anything_in_common_are_matched_with_the_next_ones_alone() -> None:
    found = likely_pairs(40, [0] * 780)
    assert Counter(second - first for first, second in found) == {step: 40 - step for step in range(1, NEIGHBOURS + 1)}


def test_a_picture_that_few_others_prefer_has_all_its_partners() -> None:
    # Picture 0 has little in common with the others, which have much in common with each other.
    pairs = all_pairs(50)
    found = likely_pairs(50, [first + second if first else second for first, second in pairs])
    assert {(0, other) for other in range(50 - PARTNERS, 50)} <= set(found)
    assert all(pair < after for pair, after in pairwise(found))
