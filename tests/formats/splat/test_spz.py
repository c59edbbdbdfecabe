"""Splats from .spz: all four versions, judged by gaussforge."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Splats, load, memory_limit, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.splat import spz
from nerfbake.formats.wire.zstd import compress
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.scene.splat_axes import AXES, directions_of, with_axes
from nerfbake.scene.splats import Axes
from tests.formats.splat.test_ply import assert_same, columns_of, converted
from tests.support.hostile import refused_as_it_is
from tests.support.splat_pictures import covariances
from tests.support.splats import gzip_spz, spark_spz, splats

# Terms of the SH whose sign changes if y and z change theirs, up to degree 3.
SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


TOC = 44  # where the table of streams starts in a file of ours, behind the extension of the axes
UNNAMED = "axes not named; read as right, up, back (SPZ's README)"


def written(scene: Splats, **options: Any) -> bytes:
    return b"".join(spz.encode(scene, **options))


def turned(scene: Splats) -> Splats:
    """The same splats with y and z in the opposite direction: what programs that keep a .spz's axes read."""
    return Splats(
        scene.means * np.array([1, -1, -1], np.float32),
        scene.scales,
        scene.quats * np.array([1, 1, -1, -1], np.float32),
        scene.opacity,
        scene.sh * SIGNS[: scene.B, None],
        scene.antialiased,
    )


def assert_near(found: Splats, scene: Splats, *, place: float = 1e-6) -> None:
    """As near as the format's steps are."""
    np.testing.assert_allclose(found.means, scene.means, atol=place)
    np.testing.assert_allclose(np.log(found.scales), np.log(scene.scales), atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh[:, 0], scene.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-5)
    np.testing.assert_allclose(found.sh[:, 1:], scene.sh[:, 1:], atol=0.5 / 128 + 1e-6)
    assert found.antialiased == scene.antialiased


def assert_same_shapes(found: Splats, scene: Splats, *, atol: float) -> None:
    """The same ellipsoids, whose axes may come in another order."""
    one, other = covariances(found), covariances(scene)
    size = np.sqrt(np.einsum("nij,nij->n", other, other))[:, None, None]
    np.testing.assert_allclose(one / size, other / size, atol=atol)


def assert_same_turns(found: Splats, scene: Splats, least: float) -> None:
    assert np.abs((found.quats * scene.quats).sum(axis=1)).min() > least


@pytest.mark.parametrize("degree", range(5))
def test_there_and_back(degree: int, tmp_path: Path) -> None:
    scene = splats(70, degree=degree, antialiased=degree == 1)
    save(tmp_path / "a.spz", scene)
    found = load(tmp_path / "a.spz", Splats)
    assert_near(found, scene)
    assert_same_turns(found, scene, 1 - 1e-5)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_first_versions_are_read(version: int, tmp_path: Path) -> None:
    scene = splats(40, antialiased=True)
    (tmp_path / "a.spz").write_bytes(gzip_spz(scene, version))
    found = load(tmp_path / "a.spz", Splats)
    assert_near(found, turned(scene), place=2e-3 if version == 1 else 2e-4)
    assert_same_turns(found, turned(scene), 1 - (1e-5 if version == 3 else 1e-2))


def test_what_was_read_is_written_without_further_loss() -> None:
    once = spz.decode(memoryview(written(splats(200, degree=3))))
    again = spz.decode(memoryview(written(once)))
    assert_same(again, once, atol=2e-3)
    assert np.array_equal(again.means, once.means)
    assert np.array_equal(again.sh, once.sh)


def extended(scene: Splats, extensions: bytes, version: int = 4) -> bytes:
    """A file with these extensions."""
    if version < 4:
        whole = bytearray(gzip.decompress(gzip_spz(scene, version)) + extensions)
        whole[14] |= 2
        return gzip.compress(whole)
    data = bytearray(written(scene))
    data[16:20] = struct.pack("<I", 32 + len(extensions))
    return bytes(data[:32] + extensions + data[TOC:])


# Directions of x, y, z in the world of a .ply, where x points right, y down and z forward.
SYSTEMS = {
    0: [[1, 0, 0], [0, -1, 0], [0, 0, -1]],  # not specified: right, up, back
    4: [[1, 0, 0], [0, -1, 0], [0, 0, -1]],  # right, up, back
    6: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # right, down, forward
    7: [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],  # left, up, forward
    12: [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # right, forward, up
    15: [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],  # left, back, up: a mirrored system
}


def colours_along(scene: Splats, ways: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("db,nbc->ndc", sh_basis(ways, scene.B), scene.sh))


def some_directions() -> np.ndarray:
    ways = np.random.default_rng(1).normal(size=(9, 3))
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))


@pytest.mark.parametrize("number", SYSTEMS)
@pytest.mark.parametrize("version", [3, 4])
def test_the_axes_that_an_extension_names_are_obeyed(number: int, version: int) -> None:
    scene = splats(30, degree=2)
    plain = spz.decode(memoryview(written(scene) if version == 4 else gzip_spz(scene, version))).flipped()
    found = spz.decode(memoryview(extended(scene, struct.pack("<III", 0xADBE0003, 4, number), version)))
    axes = np.array(SYSTEMS[number], np.float32)
    np.testing.assert_allclose(found.means, plain.means @ axes, atol=1e-6)
    ways = some_directions()
    np.testing.assert_allclose(colours_along(found, ways @ axes), colours_along(plain, ways), atol=1e-5)
    assert found.axes == AXES[(number or 4) - 1]
    if number == 0:
        assert found.notes == (UNNAMED,)
    elif number == 4:
        assert found.notes == ()
    else:
        assert found.notes == (f"an extension says that the axes of the file are {found.axes} instead of RUB",)


@pytest.mark.parametrize("axes", AXES)
def test_any_axes_are_written_and_named(axes: Axes) -> None:
    """The same splats come back; what another reader finds is in the named directions."""
    scene = splats(30, degree=3)
    data = written(scene, axes=axes)
    assert struct.unpack_from("<III", data, 32) == (0xADBE0003, 4, AXES.index(axes) + 1)
    found = spz.decode(memoryview(data))
    np.testing.assert_allclose(found.means, scene.means, atol=1e-6)
    assert_same_shapes(found, spz.decode(memoryview(written(scene))), atol=2e-2)
    unnamed = data[:32] + struct.pack("<III", 0xADBE0003, 4, 6) + data[TOC:]  # read as right, down, forward: as stored
    ways, directions = some_directions(), directions_of(axes).astype(np.float32)
    stored = spz.decode(memoryview(unnamed))
    np.testing.assert_allclose(stored.means, scene.means @ directions.T, atol=1e-6)
    # A coefficient of the turned SH may be beyond 1, which the format cuts off.
    inside = (np.abs(stored.sh[:, 1:]) < 0.98).all(axis=(1, 2))
    assert inside.sum() > 5
    close = np.abs(colours_along(stored, ways @ directions.T) - colours_along(scene, ways))[inside]
    assert close.max() < 0.06
    assert np.sqrt((close**2).mean()) < 0.015


def test_named_axes_can_be_overruled() -> None:
    scene = splats(30, degree=3)
    as_stored = written(scene, axes="RDF")
    wrong = spz.decode(memoryview(as_stored[:32] + struct.pack("<III", 0xADBE0003, 4, 4) + as_stored[TOC:]))
    assert np.abs(wrong.means - scene.means).max() > 1
    right = with_axes(wrong, "RDF")
    assert_same(right, spz.decode(memoryview(as_stored)), atol=0)
    assert (right.axes, right.axes_known) == ("RDF", True)
    assert with_axes(right, "RDF").means is right.means
    mirrored = with_axes(wrong, "LBU")
    np.testing.assert_array_equal(mirrored.means, spz.decode(memoryview(
        as_stored[:32] + struct.pack("<III", 0xADBE0003, 4, 15) + as_stored[TOC:]
    )).means)  # fmt: skip


def test_version_3_is_gzip_and_names_its_axes_only_if_they_are_others(tmp_path: Path) -> None:
    """three.js 0.187 refuses the extension in version 3, and Babylon.js 9.28 takes its flag for antialiased splats."""
    scene = splats(50, degree=3)
    (tmp_path / "a.spz").write_bytes(written(scene, spz_version=3))
    whole = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert whole[:16] == struct.pack("<4sIIBBBB", b"NGSP", 3, 50, 3, whole[13], 0, 0)
    assert len(whole) == 16 + 50 * (9 + 1 + 3 + 3 + 4 + 45)
    found = load(tmp_path / "a.spz", Splats)
    assert_same(found, spz.decode(memoryview(written(scene))), atol=0)
    assert (found.axes, found.antialiased, found.notes) == ("RUB", False, (UNNAMED,))
    assert_same(columns_of(converted(written(scene, spz_version=3), "spz")), turned(found), atol=1e-5)
    other = gzip.decompress(written(replace(scene, antialiased=True), spz_version=3, axes="RDF"))
    assert (other[14], other[-12:]) == (3, struct.pack("<III", 0xADBE0003, 4, 6))
    assert len(other) == len(whole) + 12
    with pytest.raises(InvalidScene, match=r"sh has degree 4; allowed: 0 to 3 in version 3 of a \.spz"):
        written(splats(2, degree=4), spz_version=3)


def test_other_extensions_are_left_out_with_a_note() -> None:
    scene = splats(3)
    found = spz.decode(memoryview(extended(scene, struct.pack("<IIfff", 0xADBE0002, 12, 1, 2, 3))))
    assert found.notes == ("extension 0xADBE0002 is left out", UNNAMED)
    assert_near(found, scene)


def test_a_small_file_has_the_steps_of_niantics_writer() -> None:
    scene = splats(3000, degree=3)
    plain, small = (spz.decode(memoryview(b"".join(spz.encode(scene, small=each)))) for each in (False, True))
    codes = np.rint(small.sh * 128).astype(int)
    assert not (codes[:, 1:4] % 8).any()
    assert not (codes[:, 4:] % 16).any()
    np.testing.assert_allclose(small.sh[:, 1:4], scene.sh[:, 1:4], atol=4.5 / 128)
    np.testing.assert_allclose(small.sh[:, 4:], scene.sh[:, 4:], atol=8.5 / 128)
    assert np.array_equal(small.sh[:, 0], plain.sh[:, 0])
    sizes = [len(b"".join(spz.encode(scene, small=each))) for each in (False, True)]
    assert sizes[1] < 0.8 * sizes[0]


def test_a_large_scene_keeps_its_far_splats() -> None:
    scene = splats(5)
    scene.means[0] = 5_000_000
    np.testing.assert_allclose(spz.decode(memoryview(written(scene))).means, scene.means, atol=0.5)
    scene.means[0] = 1e7
    with pytest.raises(InvalidScene, match=r"means reach 1e\+07; allowed: 8,388,607 in a \.spz"):
        written(scene)


@pytest.mark.parametrize("degree", range(4))
def test_gaussforge_reads_what_we_write(degree: int) -> None:
    """It keeps the file's axes."""
    scene = splats(60, degree=degree)
    data = written(scene)
    assert_same(columns_of(converted(data, "spz")), turned(spz.decode(memoryview(data))), atol=1e-5)


@pytest.mark.parametrize("version", [2, 3])
def test_gaussforge_reads_the_first_versions_as_we_do(version: int) -> None:
    data = gzip_spz(splats(60), version)
    assert_same(columns_of(converted(data, "spz")), turned(spz.decode(memoryview(data))), atol=1e-5)


def flagged(whole: bytes, flags: int) -> bytes:
    return whole[:14] + bytes([whole[14] | flags]) + whole[15:]


def counted(packed: bytes, n: int) -> bytes:
    """The same attributes with another number of splats."""
    whole = gzip.decompress(packed)
    return gzip.compress(whole[:8] + struct.pack("<I", n) + whole[12:], mtime=0)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_first_versions_are_read_without_gzip(version: int, tmp_path: Path) -> None:
    packed = gzip_spz(splats(40), version)
    (tmp_path / "a.spz").write_bytes(gzip.decompress(packed))
    assert_same(load(tmp_path / "a.spz", Splats), spz.decode(memoryview(packed)), atol=0)


@pytest.mark.data
def test_a_file_of_version_2_without_gzip_is_read(data: Path) -> None:
    found = load(data / "reports/F10_wrapped_files/raw_v2.spz", Splats)
    assert_same(found, load(data / "reports/F2_lod_spz/leaf.spz", Splats), atol=0)


@pytest.mark.parametrize("version", [2, 3])
def test_of_levels_of_detail_the_leaves_are_read_with_their_opacity(version: int) -> None:
    """A root with a leaf and a parent of two leaves: rows 1, 3 and 4 have no children."""
    scene = splats(5, degree=1)
    scene.opacity[4] = 1  # half of it is written as 128, which doubled is above 255
    found = spz.decode(memoryview(spark_spz(scene, [(2, 1), (0, 0), (2, 3), (0, 0), (0, 0)], version)))
    expected = spz.decode(memoryview(gzip_spz(scene, version)))
    rows = [1, 3, 4]
    for name in ("means", "scales", "quats", "sh"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)[rows])
    np.testing.assert_allclose(found.opacity, scene.opacity[rows], atol=1 / 255)
    assert found.opacity[2] == 1
    assert found.notes == ("of the levels of detail (flag 0x80), only the finest is read: 3 of 5 rows", UNNAMED)


@pytest.mark.data
def test_the_leaves_of_sparks_levels_are_the_file_they_were_made_of(data: Path) -> None:
    found, leaves = (load(data / f"reports/F2_lod_spz/{name}.spz", Splats) for name in ("lod", "leaf"))
    assert found.n == leaves.n == 800
    order, of = (np.lexsort(each.means.T) for each in (found, leaves))
    assert np.array_equal(found.means[order], leaves.means[of])
    np.testing.assert_allclose(found.opacity[order], leaves.opacity[of], atol=1 / 255)


def test_reserved_bytes_are_told() -> None:
    """They may once say what is not read."""
    whole = bytearray(gzip.decompress(gzip_spz(splats(2), 3)))
    whole[15] = 7
    assert spz.decode(memoryview(whole)).notes == ("byte 15, which is reserved, is 7 and not 0", UNNAMED)
    whole = bytearray(written(splats(2)))
    whole[31] = 1
    assert spz.decode(memoryview(whole)).notes == ("bytes 20 to 31, which are reserved, are not 0",)


def test_a_dull_file_has_a_limit_by_its_bytes() -> None:
    """65,536 splats may be as equal as they like; more need a byte for 16."""
    one = gzip.decompress(gzip_spz(splats(1, degree=0), 3))[16:]

    def equal(n: int) -> memoryview:
        parts = (one[:9], one[9:10], one[10:13], one[13:16], one[16:20])
        return memoryview(gzip.compress(header(3, n) + b"".join(part * n for part in parts)))

    assert spz.decode(equal(1 << 16)).n == 1 << 16
    with pytest.raises(InvalidFile, match="bytes for 200,000 splats; allowed: 16 splats a byte at most"):
        spz.decode(equal(200_000))


# -- hostile files ---------------------------------------------------------------------------------------------
SOUND = written(splats(3, degree=1))


def header(version: int, n: int, degree: int = 0, bits: int = 12, streams: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, n, degree, bits, 0, streams)


def bombed(n: int) -> bytes:
    """Version 4 whose first stream holds 64 MiB of zeros."""
    bomb = b"".join(compress([bytes(1 << 24)] * 4))
    toc = struct.pack("<QQ", len(bomb), 9 * n) + struct.pack("<QQ", 0, 0) * 4
    return header(4, n, streams=5) + struct.pack("<I12x", 32) + toc + bomb


LIES: dict[str, tuple[bytes, str]] = {
    "2^32 in gzip": (gzip.compress(header(3, 2**32 - 1)), "bytes for 4,294,967,295 splats; allowed: 16 splats a byte"),
    "65,536 in gzip": (gzip.compress(header(3, 1 << 16)), "declares 1,310,736 bytes from"),
    "2^32 in zstd": (
        header(4, 2**32 - 1, streams=5)
        + struct.pack("<I12x", 32)
        + b"".join(struct.pack("<QQ", 4, each * (2**32 - 1)) for each in (9, 1, 3, 3, 4)),
        "bytes for 4,294,967,295 splats",
    ),
    "65,536 in zstd": (
        header(4, 1 << 16, streams=5)
        + struct.pack("<I12x", 32)
        + b"".join(struct.pack("<QQ", 4, each << 16) for each in (9, 1, 3, 3, 4)),
        "stream positions declares",
    ),
    "a zstd bomb": (bombed(1000), "stream positions holds more than 9,000 bytes; allowed: 9,000 exactly"),
    "another size": (
        bombed(1000).replace(struct.pack("<Q", 9000), struct.pack("<Q", 1 << 30)),
        "declares 1,073,741,824",
    ),
    "degree 255": (SOUND[:12] + b"\xff" + SOUND[13:], "the SH degree is 255; allowed: 0 to 4"),
    "bits 255": (SOUND[:13] + b"\xff" + SOUND[14:], "the fractional bits are 255; allowed: 0 to 24"),
    "an axis of 99": (
        extended(splats(1), struct.pack("<III", 0xADBE0003, 4, 99)),
        "the extension of the axes has 4 bytes, with 99; allowed: 4 bytes, with 0 to 16",
    ),
    "version 5": (SOUND[:4] + b"\5" + SOUND[5:], "version is 5; allowed: 1 to 3, mostly in gzip, or 4 without"),
    "no rows": (SOUND[:8] + bytes(4) + SOUND[12:], "have no rows"),
    "streams": (SOUND[:15] + b"\xff" + SOUND[16:], "has 255 streams; allowed: 6"),
    "toc": (SOUND[:16] + b"\xff" * 4 + SOUND[20:], "the table of streams is at byte 4,294,967,295"),
    "a long stream": (
        SOUND[:TOC] + b"\xff" * 8 + SOUND[TOC + 8 :],
        "stream positions declares 18,446,744,073,709,551,615",
    ),
    "too few": (gzip.compress(header(3, 10) + bytes(100)), "holds 100 bytes of attributes; allowed: 200"),
    "cut gzip": (gzip_spz(splats(9), 3)[:60], "the .spz is cut off after"),
    "cut CRC": (gzip_spz(splats(9), 3)[:-5], "the .spz is cut off after"),
    "another CRC": (gzip_spz(splats(9), 3)[:-8] + b"1234" + gzip_spz(splats(9), 3)[-4:], "the .spz is damaged"),
    "a count too low": (counted(gzip_spz(splats(9), 3), 8), "the .spz continues after 368 bytes"),
    "a count too low, in the clear": (
        gzip.decompress(counted(gzip_spz(splats(9), 3), 8)),
        "the .spz holds 396 bytes of attributes; allowed: 352 for 8 splats",
    ),
    "a count too low, with extensions": (
        gzip.compress(flagged(gzip.decompress(counted(gzip_spz(splats(9), 3), 8)), 2)),
        "an extension of type",
    ),
    "an unknown flag": (gzip.compress(flagged(gzip.decompress(gzip_spz(splats(1), 3)), 4)), "the flags have 0x04"),
    "an unknown flag in version 4": (flagged(SOUND, 0x80), "the flags have 0x80; allowed: 1 antialiased, 2 extensions"),
    "bytes after version 4": (SOUND + b"\0", "the .spz goes on after its streams"),
    "a cut extension": (
        extended(splats(1), struct.pack("<II", 1, 5) + b"1234"),
        "an extension of type 0x00000001 has 5",
    ),
    "a child in another file": (
        spark_spz(splats(4), [(3, 2), (0, 0), (0, 0), (0, 0)]),
        "the tree of the levels of detail has children up to row 5 of 4",
    ),
    "no leaves": (spark_spz(splats(2), [(1, 1), (1, 0)]), "the tree of the levels of detail has no leaves"),
    "no tree": (
        gzip.compress(flagged(gzip.decompress(gzip_spz(splats(2), 2)), 0x80)),
        "of attributes; allowed: 98 for 2",
    ),
    "cut": (SOUND[:20], "the table of streams"),
    "no header": (SOUND[:9], "has no whole header"),
    "a signalling NaN": (gzip.compress(header(1, 1) + b"\1\x7c" * 8), "have 1 row of 1 that cannot be drawn"),
    "NaN": (gzip.compress(header(1, 1) + b"\xff" * 16), "have 1 row of 1 that cannot be drawn"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_spz_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.spz", content, capsys)


def test_no_more_of_a_gzip_bomb_is_unpacked_than_its_count_tells() -> None:
    turn = struct.pack("<I", 3 << 30)
    bomb = gzip.compress(header(3, 3) + bytes(3 * 16) + turn * 3 + bytes(1 << 26))
    tracemalloc.start()
    with pytest.raises(InvalidFile, match="continues after 76 bytes"):
        spz.decode(memoryview(bomb))
    assert tracemalloc.get_traced_memory()[1] < 1 << 24
    tracemalloc.stop()


@pytest.mark.parametrize("version", [1, 2, 3])
def test_no_change_of_a_bit_is_read_silently(version: int) -> None:
    """Of a byte of the stream, its CRC tells; of the header, also what it declares."""
    whole = gzip.decompress(gzip_spz(splats(5, degree=1), version))
    for at in range(8 * 12):
        changed = bytearray(whole)
        changed[at // 8] ^= 1 << at % 8
        with pytest.raises((InvalidFile, InvalidScene)):
            spz.decode(memoryview(changed))


@pytest.mark.data
def test_a_count_of_which_a_bit_is_lost_is_refused(data: Path) -> None:
    with pytest.raises(InvalidFile, match="incorrect data check"):
        load(data / "hostile4/spz_count/one_bit.spz")


def test_a_small_file_of_version_4_needs_little_memory(tmp_path: Path) -> None:
    """zstd's window counts only where it is allocated, and as the frame declares it."""
    (tmp_path / "a.spz").write_bytes(written(splats(9)))
    with memory_limit(1 << 20):
        assert load(tmp_path / "a.spz", Splats).n == 9
