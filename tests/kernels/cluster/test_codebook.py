"""Codebooks of numbers and palettes of rows."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels.cluster.codebook import fit_codebook, fit_palette, nearest_codes


def loss(values: np.ndarray, book: np.ndarray) -> float:
    return float(((values - book[nearest_codes(values, book)]) ** 2).mean())


def test_few_numbers_are_kept() -> None:
    values = np.array([3.0, 1.0, 3.0, 2.0])
    book = fit_codebook(values)
    assert book.tolist() == [1, 2, *[3.0] * 254]
    np.testing.assert_array_equal(book[nearest_codes(values, book)], values)


@pytest.mark.parametrize("kind", ["normal", "uniform", "cubed"])
def test_a_codebook_is_better_than_even_steps_and_quantiles(kind: str) -> None:
    values = np.random.default_rng(0).normal(size=20_000)
    values = {"normal": values, "uniform": np.random.default_rng(0).uniform(size=20_000), "cubed": values**3}[kind]
    book = fit_codebook(values)
    even = np.linspace(values.min(), values.max(), 256)
    quantiles = np.quantile(values, (np.arange(256) + 0.5) / 256)
    assert (np.diff(book) >= 0).all()
    assert loss(values, book) <= 1.02 * min(loss(values, even), loss(values, quantiles))


def test_codes_are_the_nearest_entries() -> None:
    values, book = np.linspace(-3, 3, 777), np.sort(np.random.default_rng(1).normal(size=256))
    np.testing.assert_array_equal(nearest_codes(values, book), np.abs(values[:, None] - book).argmin(axis=1))


def test_few_rows_are_kept_and_clusters_are_found() -> None:
    random = np.random.default_rng(2)
    middles = random.normal(size=(20, 5)).astype(np.float32) * 10
    which = random.integers(0, 20, 900)
    rows = (middles[which] + random.normal(size=(900, 5)) * 0.01).astype(np.float32)
    palette, label = fit_palette(rows, 60)
    assert palette.shape == (60, 5)
    assert np.sqrt(((palette[label] - rows) ** 2).mean()) < 0.1 * rows.std()
    palette, label = fit_palette(rows, 900)
    np.testing.assert_array_equal(palette[label], rows)
    equal, label = fit_palette(np.ones((50, 3), np.float32), 7)
    assert len(equal) == 1
    assert not label.any()


def test_each_entry_is_the_mean_of_its_rows() -> None:
    rows = np.random.default_rng(3).normal(size=(500, 4)).astype(np.float32)
    palette, label = fit_palette(rows, 64)
    assert np.unique(label).tolist() == list(range(64))
    for k in range(64):
        np.testing.assert_allclose(palette[k], rows[label == k].mean(axis=0), atol=1e-6)
