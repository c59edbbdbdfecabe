"""Splats from .ksplat, at all levels of compression."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Splats, load
from nerfbake.formats.splat import ksplat as form
from tests.support.hostile import refused_as_it_is
from tests.support.splats import ksplat, splats


def assert_near(found: Splats, scene: Splats, level: int) -> None:
    np.testing.assert_allclose(found.means, scene.means, atol=1e-3 if level else 0)
    np.testing.assert_allclose(found.scales, scene.scales, rtol=1e-3 if level else 0)
    np.testing.assert_allclose(np.abs((found.quats * scene.quats).sum(axis=1)), 1, atol=1e-5)
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh[:, 0], scene.sh[:, 0], atol=0.5 / 255 / 0.282 + 1e-5)
    np.testing.assert_allclose(found.sh[:, 1:], scene.sh[:, 1:], atol=(0, 1e-3, 0.5 * 3 / 255 + 1e-6)[level])


@pytest.mark.parametrize("level", range(3))
@pytest.mark.parametrize("degree", range(4))
def test_each_level_and_degree_is_read(level: int, degree: int, tmp_path: Path) -> None:
    scene = splats(30, degree=degree)
    scene.sh[:, 0] *= 0.5  # colours of bytes
    (tmp_path / "a.ksplat").write_bytes(ksplat([scene], level))
    found = load(tmp_path / "a.ksplat", Splats)
    assert_near(found, scene, level)
    assert (found.axes, found.notes) == (None, ())
    assert form.recognise(memoryview(ksplat([scene], level)))


def test_sections_are_joined_with_the_highest_degree() -> None:
    parts = [splats(9, degree=2), splats(6, degree=0, seed=1), splats(5, degree=1, seed=2)]
    found = form.decode(memoryview(ksplat(parts, 1)))
    assert (found.n, found.degree) == (20, 2)
    np.testing.assert_allclose(found.means, np.concatenate([part.means for part in parts]), atol=1e-3)
    assert not found.sh[9:15, 1:].any()


def test_the_header_has_the_range_of_sh() -> None:
    scene = splats(9, degree=1)
    scene.sh[:, 0] *= 0.5
    assert_near(form.decode(memoryview(ksplat([scene], 2, ends=(-0.75, 1)))), scene, 2)
    usual = bytearray(ksplat([scene], 2))
    usual[36:44] = bytes(8)
    assert_near(form.decode(memoryview(usual)), scene, 2)


SOUND = ksplat([splats(9, degree=1)], 1)


def changed(at: int, kind: str, *values: float) -> bytes:
    data = bytearray(SOUND)
    struct.pack_into(kind, data, at, *values)
    return bytes(data)


HEAD = 4096
LIES: dict[str, tuple[bytes, str]] = {
    "no header": (SOUND[:1000], "has 1,000 bytes; allowed: a header of 4,096"),
    "a version": (changed(0, "<BB", 1, 0), "version is 1.0; allowed: 0.1 or later"),
    "a level": (changed(20, "<H", 7), "the level of compression is 7; allowed: 0, 1 or 2"),
    "2^32 sections": (changed(4, "<I", 2**32 - 1), "the sections are 4,294,967,295 in"),
    "2^32 splats": (changed(HEAD, "<II", 2**32 - 1, 2**32 - 1), "section 0 has 4,294,967,295 of 4,294,967,295 splats"),
    "another count": (changed(16, "<I", 10), "the sections have 9 splats; allowed: 10, as the header says"),
    "more than most": (changed(HEAD, "<I", 10), "section 0 has 10 of 9 splats"),
    "a degree": (changed(HEAD + 40, "<H", 9), "section 0's SH degree is 9; allowed: 0 to 3"),
    "small buckets": (changed(HEAD + 20, "<H", 3), "section 0 has 3 of 3 buckets of 3 bytes; allowed: buckets of 12"),
    "fewer buckets": (changed(HEAD + 8, "<I", 1), "the buckets have room for 3 splats; allowed: 9"),
    "more buckets": (changed(HEAD + 32, "<I", 3), "section 0 has 4 of 3 buckets"),
    "cut": (SOUND[:-1], "section 0 has 9 of 9 splats, up to byte"),
    "no splats": (SOUND[:16] + bytes(4) + SOUND[20:HEAD] + bytes(8) + SOUND[HEAD + 8 :], "have no rows"),
    "NaN": (changed(HEAD + 16, "<f", float("nan")), "have 9 rows of 9 that cannot be drawn"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_ksplat_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.ksplat", content, capsys)
    assert not form.recognise(memoryview(content)) or lie == "NaN" or "buckets" in lie
