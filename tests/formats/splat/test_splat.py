"""Splats from .splat, judged by gaussforge."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Splats, load
from nerfbake.formats.splat import ply, splat
from tests.formats.splat.test_ply import assert_same, columns_of, converted
from tests.support.hostile import refused_as_it_is
from tests.support.splats import splat_rows, splats


def test_one_splat_by_hand(tmp_path: Path) -> None:
    row = struct.pack("<6f8B", 1, 2, 3, 0.5, 0.25, 77, 255, 0, 51, 102, 128, 128, 128, 0)
    (tmp_path / "a.splat").write_bytes(row)
    found = load(tmp_path / "a.splat", Splats)
    assert (found.means.tolist(), found.scales.tolist()) == ([[1, 2, 3]], [[0.5, 0.25, 77]])
    assert found.quats.tolist() == [[0, 0, 0, -1]]
    np.testing.assert_allclose(found.opacity, [0.4], rtol=1e-6)
    np.testing.assert_allclose(found.sh[0, 0], np.array([0.5, -0.5, -0.3]) / 0.28209479177, rtol=1e-6)


def test_it_is_near_what_was_packed() -> None:
    scene = splats(300, degree=0)
    found = splat.decode(memoryview(splat_rows(scene)))
    assert np.array_equal(found.means, scene.means)
    assert np.array_equal(found.scales, scene.scales)
    assert np.abs((found.quats * scene.quats).sum(axis=1)).min() > 1 - 1e-4
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh, scene.sh, atol=0.5 / 255 / 0.282 + 1e-6)


def test_gaussforge_reads_it_as_we_do() -> None:
    data = splat_rows(splats(60, degree=0))
    assert_same(splat.decode(memoryview(data)), columns_of(converted(data, "splat")), atol=1e-5)


def test_we_read_what_gaussforge_writes() -> None:
    gaussforge = pytest.importorskip("gaussforge")
    source = b"".join(ply.encode(splats(60, degree=0)))
    data = bytes(gaussforge.GaussForge().convert(source, "ply", "splat")["data"])
    assert splat.recognise(memoryview(data))
    assert_same(splat.decode(memoryview(data)), columns_of(converted(data, "splat")), atol=1e-5)


SOUND = splat_rows(splats(3))
LIES = {
    "cut": (SOUND[:-1], "the .splat has 95 bytes; allowed: a multiple of 32, the bytes of a row"),
    "NaN": (b"\xff" * 64 + SOUND[:32], "have 2 rows of 3 that cannot be drawn"),
    "no turn": (SOUND[:28] + b"\x80" * 4, "have 1 row of 1 that cannot be drawn"),
    "a text": (b"all work and no play makes jack a dull boy"[:31], "has 31 bytes"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_splat_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.splat", content, capsys)
