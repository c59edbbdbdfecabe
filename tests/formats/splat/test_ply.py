"""Splats from .ply: every kind that trainers and editors write, judged by plyfile and gaussforge."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Splats, load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.splat import ply
from tests.support.hostile import refused_as_it_is
from tests.support.splats import packed_ply, ply_text, splats, text_ply

NAMES = ("means", "scales", "quats", "opacity", "sh")


def assert_same(one: Splats, other: Splats, atol: float = 1e-6) -> None:
    for name in NAMES:
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol, rtol=1e-5, err_msg=name)
    assert one.antialiased == other.antialiased


def written(scene: Splats) -> bytes:
    return b"".join(ply.encode(scene))


def respelled(data: bytes, dtype: str, order: str, *, without: tuple[str, ...] = ()) -> bytes:
    """The same rows with the properties in the opposite order, another type, and another byte order."""
    header, _, rows = data.partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    table = np.frombuffer(rows, "<f4").reshape(-1, len(names))
    kept = [k for k, name in reversed(list(enumerate(names))) if name not in without]
    kind = {"f4": "float", "f8": "double"}[dtype]
    text = ply_text({"vertex": (len(table), [f"{kind} {names[k]}" for k in kept])}, order)
    return text + table[:, kept].astype({"little": "<", "big": ">"}[order] + dtype).tobytes()


def listed(data: bytes, faces: bytes, rows: int = 9) -> bytes:
    """The same file with an element of lists before the splats."""
    head, _, rest = data.partition(b"element vertex")
    element = f"element face {rows}\nproperty list uchar ushort v\nproperty uchar k\n".encode()
    names, _, body = rest.partition(b"end_header\n")
    return head + element + b"element vertex" + names + b"end_header\n" + faces + body


def test_one_splat_by_hand(tmp_path: Path) -> None:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += [f"f_rest_{k}" for k in range(9)] + [f"rot_{k}" for k in range(4)]
    row: list[float] = [1, 2, 3, 0.1, 0.2, 0.3, 0, 0, np.log(2), np.log(3), *range(9), 0, 0, 0, 5]
    data = ply_text({"vertex": (1, [f"float {name}" for name in names])}) + np.array(row, "<f4").tobytes()
    (tmp_path / "a.ply").write_bytes(data)
    found = load(tmp_path / "a.ply", Splats)
    assert found.means.tolist() == [[1, 2, 3]]
    np.testing.assert_allclose(found.scales, [[1, 2, 3]], rtol=1e-6)
    assert found.quats.tolist() == [[0, 0, 0, 1]]
    assert found.opacity.tolist() == [0.5]
    # f_rest: all red, all green, all blue.
    np.testing.assert_allclose(found.sh[0], [[0.1, 0.2, 0.3], [0.0, 3, 6], [1.0, 4, 7], [2.0, 5, 8]], rtol=1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_there_and_back(degree: int, tmp_path: Path) -> None:
    scene = splats(70, degree=degree, antialiased=degree == 2)
    save(tmp_path / "a.ply", scene)
    assert_same(scene, load(tmp_path / "a.ply", Splats))


def test_opaque_invisible_tiny_and_huge_splats_come_back() -> None:
    scene = splats(4)
    scene.opacity[:] = [0, 1, 0.5, 1]
    scene.scales[0], scene.scales[1] = 0, 1e15
    assert_same(scene, ply.decode(memoryview(written(scene))), atol=1e-7)


def test_degree_4_is_refused() -> None:
    with pytest.raises(InvalidScene, match=r"sh has degree 4; allowed: 0 to 3 in a \.ply"):
        written(splats(2, degree=4))


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_any_order_type_and_endian(dtype: str, order: str) -> None:
    scene = splats(6, degree=3)
    spelled = respelled(written(scene), dtype, order, without=("nx", "ny", "nz"))
    assert_same(ply.decode(memoryview(spelled)), scene)
    windows = spelled[: spelled.index(b"end_header")].replace(b"\n", b"\r\n")
    rest = spelled[spelled.index(b"end_header") :].replace(b"end_header\n", b"end_header\r\n", 1)
    assert_same(ply.decode(memoryview(windows + rest)), scene)


@pytest.mark.parametrize("ends", [b"\n", b"\r\n"])
def test_text_is_read(ends: bytes) -> None:
    scene = splats(20, degree=1)
    assert_same(ply.decode(memoryview(text_ply(scene).replace(b"\n", ends))), scene)
    face = b"element face 2\nproperty list uchar int v\n"
    before = text_ply(scene).replace(b"element vertex", face + b"element vertex")
    assert_same(ply.decode(memoryview(before.replace(b"end_header\n", b"end_header\n3 0 1 2\n2 0 1\n"))), scene)
    assert_same(ply.decode(memoryview(text_ply(scene)[:-1])), scene)


def test_lists_before_the_splats_are_skipped() -> None:
    scene = splats(6)
    data = written(scene)
    assert_same(ply.decode(memoryview(listed(data, b"\3abcabc\7" * 9))), scene)
    odd = b"".join(bytes([length]) + b"ab" * length + b"\7" for length in range(9))
    assert_same(ply.decode(memoryview(listed(data, odd))), scene)


def test_a_flat_splat_is_as_thick_as_a_hundredth_of_its_smaller_axis() -> None:
    scene = splats(6)
    found = ply.decode(memoryview(respelled(written(scene), "f4", "little", without=("scale_2",))))
    np.testing.assert_allclose(found.scales[:, 2], scene.scales[:, :2].min(axis=1) / 100, rtol=1e-5)


def test_the_filter_of_mip_splatting_grows_splats_and_keeps_their_mass() -> None:
    scene = splats(6)
    data = written(scene).replace(b" nx\n", b" filter_3D\n")
    at = data.index(b"end_header\n") + 11
    rows = np.frombuffer(data[at:], "<f4").reshape(6, -1).copy()
    rows[:, 3] = 0.01
    found = ply.decode(memoryview(data[:at] + rows.tobytes()))
    np.testing.assert_allclose(found.scales, np.sqrt(scene.scales**2 + 1e-4), rtol=1e-5)
    mass = scene.opacity * scene.scales.prod(axis=1)
    np.testing.assert_allclose(found.opacity * found.scales.prod(axis=1), mass, rtol=1e-5)


def with_column(data: bytes, name: str, values: list[float]) -> bytes:
    """The same file with other numbers in one column."""
    header, _, rows = data.partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    table = np.frombuffer(rows, "<f4").reshape(-1, len(names)).copy()
    table[:, names.index(name)] = values
    return header + b"end_header\n" + table.tobytes()


def test_infinite_logits_and_logarithms_are_the_numbers_that_they_stand_for() -> None:
    # Niantic and PlayCanvas write logit(255 / 255), logit(0 / 255) and log(0) in this way.
    scene = splats(4)
    data = with_column(written(scene), "opacity", [np.inf, -np.inf, 0, np.nan])
    found = ply.decode(memoryview(with_column(data, "scale_2", [0, -np.inf, -np.inf, 0])))
    assert found.opacity.tolist() == [1, 0, 0.5]
    assert found.scales[:, 2].tolist() == [1, 0, 0]
    assert found.dropped == 1
    found = ply.decode(memoryview(with_column(data, "scale_0", [0, np.inf, 0, 0])))
    assert (found.n, found.dropped) == (2, 2)


def test_names_with_cloudcompares_prefix_are_read() -> None:
    scene = splats(6, degree=1, antialiased=True)
    data = written(scene)
    for name in (b"f_dc", b"f_rest", b"opacity", b"scale", b"rot"):
        data = data.replace(b"float " + name, b"float scalar_" + name)
    assert_same(ply.decode(memoryview(data)), scene)
    twice = data.replace(b" nx\n", b" opacity\n")
    assert ply.decode(memoryview(twice)).opacity.tolist() == [0.5] * 6  # nx is 0


def test_colours_in_bytes_are_read() -> None:
    names = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    kinds = [f"float {name}" for name in names] + [f"uchar {name}" for name in ("red", "green", "blue")]
    row = np.array([1, 2, 3, 0, 0, 0, 0, 1, 0, 0, 0], "<f4").tobytes() + bytes([255, 0, 51])
    found = ply.decode(memoryview(ply_text({"vertex": (2, kinds)}) + row * 2))
    np.testing.assert_allclose(found.sh[:, 0] * 0.28209479 + 0.5, [[1, 0, 0.2]] * 2, atol=1e-6)
    assert (found.B, found.means[0].tolist(), found.opacity[0]) == (1, [1, 2, 3], 0.5)
    with pytest.raises(InvalidFile, match="is a point cloud"):
        ply.decode(memoryview(ply_text({"vertex": (1, [each.replace("uchar", "char") for each in kinds])}) + row))


def test_degree_4_is_read() -> None:
    scene = splats(5, degree=4)
    names = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(72)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rest = scene.sh[:, 1:].swapaxes(1, 2).reshape(5, 72)
    logits = np.log(scene.opacity / (1 - scene.opacity))[:, None]
    columns = (scene.means, scene.sh[:, 0], rest, logits, np.log(scene.scales), scene.quats)
    rows = np.concatenate(columns, axis=1).astype("<f4").tobytes()
    data = ply_text({"vertex": (5, [f"float {name}" for name in names])}) + rows
    assert_same(ply.decode(memoryview(data)), scene)


def test_the_compressed_kind_is_near_what_was_packed() -> None:
    scene = splats(300, degree=2)
    found = ply.decode(memoryview(packed_ply(scene)))
    np.testing.assert_allclose(found.means, scene.means, atol=0.005)
    np.testing.assert_allclose(found.scales, scene.scales, rtol=0.005)
    same = np.abs((found.quats * scene.quats).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-5)
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh, scene.sh, atol=0.017)


# -- judges ----------------------------------------------------------------------------------------------------
def columns_of(data: bytes) -> Splats:
    """The splats of a .ply as plyfile reads it, by the trainer's own formulas in float64."""
    plyfile = pytest.importorskip("plyfile")
    rows = plyfile.PlyData.read(io.BytesIO(data))["vertex"]
    rest = sum(name.startswith("f_rest_") for name in rows.data.dtype.names)

    def columns(*names: str) -> np.ndarray:
        return np.stack([rows[name].astype(np.float64) for name in names], axis=1)

    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        high = columns(*(f"f_rest_{k}" for k in range(rest))).reshape(len(sh), 3, -1).swapaxes(1, 2)
        sh = np.concatenate([sh, high], axis=1)
    quats = columns(*(f"rot_{k}" for k in range(4)))
    arrays = (
        columns("x", "y", "z"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        1 / (1 + np.exp(-columns("opacity")[:, 0])),
        sh,
    )
    means, scales, turns, opacity, colours = (array.astype(np.float32) for array in arrays)
    return Splats(means, scales, turns, opacity, colours)


def converted(data: bytes, form: str) -> bytes:
    """The same splats as gaussforge writes them to a .ply."""
    gaussforge = pytest.importorskip("gaussforge")
    told = gaussforge.GaussForge().convert(data, form, "ply")
    assert "error" not in told, told
    return bytes(told["data"])


@pytest.mark.parametrize("degree", range(4))
def test_plyfile_reads_what_we_write(degree: int) -> None:
    scene = splats(50, degree=degree)
    assert_same(columns_of(written(scene)), scene)


@pytest.mark.parametrize("degree", range(4))
def test_gaussforge_reads_what_we_write_and_we_read_what_it_writes(degree: int) -> None:
    scene = splats(50, degree=degree)
    theirs = converted(written(scene), "ply")
    assert_same(columns_of(theirs), scene, atol=1e-5)
    assert_same(ply.decode(memoryview(theirs)), scene, atol=1e-5)


def test_gaussforge_reads_the_compressed_kind_as_we_do() -> None:
    scene = splats(300, degree=0)  # it reads no SH of this kind
    data = packed_ply(scene)
    assert_same(ply.decode(memoryview(data)), columns_of(converted(data, "compressed.ply")), atol=1e-5)


# -- hostile files ---------------------------------------------------------------------------------------------
XYZ = ["float x", "float y", "float z"]
SOUND = written(splats(3, degree=1))
LIES: dict[str, tuple[bytes, str]] = {
    "a mesh": (
        ply_text({"vertex": (0, XYZ), "face": (0, ["list uchar int v"])}),
        "element face has no list vertex_indices",
    ),
    "points": (ply_text({"vertex": (1, XYZ)}) + bytes(12), "is a point cloud; allowed: Gaussian splats"),
    "no rows": (SOUND.replace(b"vertex 3", b"vertex 0"), "have no rows; allowed: at least one splat"),
    "2^32 rows": (SOUND.replace(b"vertex 3", b"vertex 4294967296"), "declares 4,294,967,296 rows"),
    "more digits": (SOUND.replace(b"vertex 3", b"vertex " + b"9" * 400), "has the line 'element vertex 999"),
    "no text": (SOUND.replace(b"binary_little_endian", b"ascii"), "element vertex "),
    "octlevel": (SOUND.replace(b" nx\n", b" octlevel\n"), "holds SVRaster's voxels; allowed: Gaussian splats"),
    "2^32 rows of text": (
        text_ply(splats(1)).replace(b"vertex 1", b"vertex 4294967296"),
        "4,294,967,296 rows, with 1 lines left",
    ),
    "words": (
        text_ply(splats(1)).replace(b"\n0.", b"\nnone ", 1).replace(b"\n-0.", b"\nnone ", 1),
        "has text that is not a number",
    ),
    "fewer numbers": (text_ply(splats(2)).replace(b" ", b" ", 1)[:-30] + b"\n", "element vertex has "),
    "endless lists": (listed(SOUND, b"\xff" * 9), "element face has a list of 255 entries"),
    "lists of many lengths": (listed(SOUND, bytes(range(200)) * 900, rows=150_000), "with lists of different lengths"),
    "lists of splats": (SOUND.replace(b"property float nx", b"property list uchar int nx"), "element vertex has lists"),
    "no end": (SOUND[:40], "does not end within"),
    "twice": (SOUND.replace(b" nx\n", b" x\n"), "has a property twice"),
    "no opacity": (SOUND.replace(b" opacity\n", b" opacitx\n"), "has no property opacity"),
    "odd SH": (SOUND.replace(b" f_rest_8\n", b" f_best_8\n"), "has 8 properties f_rest; allowed: 0, 9, 24, 45, 72"),
    "a gap in SH": (SOUND.replace(b" f_rest_8\n", b" f_rest_9\n"), "has no property f_rest_8"),
    "no chunks": (packed_ply(splats(3)).replace(b"element chunk", b"element chunq"), "element chunk has 0 rows"),
    "NaN": (SOUND[: -3 * 23 * 4] + b"\xff" * (3 * 23 * 4), "have 3 rows of 3 that cannot be drawn"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_ply_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.ply", content, capsys)
