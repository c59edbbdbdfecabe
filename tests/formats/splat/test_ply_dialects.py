"""What .ply files say beyond 3DGS: half floats, movement, the axis that points up, and coordinates of a map."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Splats, load, save
from nerfbake.errors import InvalidFile, NerfbakeError
from nerfbake.formats.splat import ply
from tests.support.splats import farther, halved, packed_ply, ply_text, splats, text_ply, with_property

SCENE = splats(6, degree=1)
PLAIN = b"".join(ply.encode(SCENE))
UTM = np.array([453000.125, 5012345.5, 120.25])


def read(data: bytes) -> Splats:
    return ply.decode(memoryview(data))


def commented(*lines: str) -> bytes:
    return PLAIN.replace(b"element vertex", "".join(f"comment {line}\n" for line in lines).encode() + b"element vertex")


# -- half floats -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("which", ["", "f_rest", "rot", "x", "opacity"])
def test_numbers_of_type_ushort_are_half_floats(which: str, order: str) -> None:
    found = read(halved(PLAIN, which, order))
    assert [note.partition(":")[0] for note in found.notes] == ["the properties of type ushort are read as half floats"]
    assert not found.dropped
    # Half floats have 11 bits; scales and opacities are exponentials of them.
    for name in ("means", "scales", "opacity", "sh"):
        np.testing.assert_allclose(getattr(found, name), getattr(SCENE, name), rtol=4e-3, atol=1e-3, err_msg=name)
    np.testing.assert_allclose(np.abs((found.quats * SCENE.quats).sum(axis=1)), 1, atol=1e-5)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("word", [b"half", b"float16"])
def test_half_floats_may_have_a_type_of_their_own(word: bytes, order: str) -> None:
    plain = b"".join(ply.encode(splats(30, degree=1)))
    bits = halved(plain, "", order)
    found, expected = (ply.decode(memoryview(each)) for each in (bits.replace(b"ushort", word), bits))
    for name in ("means", "scales", "quats", "opacity", "sh"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))
    assert found.notes == ()


def test_half_floats_in_text_are_their_bits() -> None:
    text = text_ply(splats(1, degree=0)).decode().replace("float opacity", "ushort opacity")
    head, _, row = text.partition("end_header\n")
    words = row.split()
    words[9] = str(0x3C00)  # 1 as a half float
    found = read(f"{head}end_header\n{' '.join(words)}\n".encode())
    np.testing.assert_allclose(found.opacity, 1 / (1 + np.exp(-1)), rtol=1e-6)


@pytest.mark.parametrize("kind", ["char", "uchar", "short", "int", "uint"])
@pytest.mark.parametrize("name", ["x", "scale_2", "rot_0", "f_dc_1", "f_rest_8", "opacity"])
def test_other_integers_are_refused_by_name_and_type(name: str, kind: str) -> None:
    data = text_ply(splats(2, degree=1)).replace(f"float {name}\n".encode(), f"{kind} {name}\n".encode())
    head, _, _ = data.partition(b"end_header\n")
    with pytest.raises(InvalidFile, match=f"has the property {name} as {kind}; allowed: float or double, or ushort"):
        read(head + b"end_header\n" + (b"0 " * 26 + b"\n") * 2)


def test_integers_elsewhere_are_as_before() -> None:
    assert read(with_property(PLAIN, "ushort id")).notes == ()
    assert read(packed_ply(splats(300, degree=1))).notes == ()


# -- movement --------------------------------------------------------------------------------------------------
MOVING: dict[str, tuple[list[str], str, str]] = {
    "Spacetime Gaussians": (
        ["float trbf_center", "float trbf_scale", "float motion_0", "float omega_3"],
        "movement (trbf_*, motion_*, omega_*)",
        "the splats of all times are shown together",
    ),
    "4DGS": (["float t", "float scale_t", "float rot_r_0"], "movement (t, scale_t, rot_r_*)", "of all times"),
    "4DGS, numbered": (["float scale_t_0", "float rot_r_3"], "movement (t, scale_t, rot_r_*)", "stand still"),
    "straight paths": (["float vx", "float vy", "float vz"], "movement (velocities, time, duration)", "stand still"),
    "paths in a time": (
        ["float velocity_x", "float time", "float duration"],
        "movement (velocities, time, duration)",
        "of all times",
    ),
}


@pytest.mark.parametrize("kind", MOVING)
def test_movement_is_told(kind: str) -> None:
    properties, left_out, seen = MOVING[kind]
    data = PLAIN
    for each in properties:
        data = with_property(data, each)
    found = read(data)
    assert found.left_out == (left_out,)
    (note,) = found.notes
    assert note.startswith(f"{left_out} is left out: the splats ")
    assert seen in note
    np.testing.assert_array_equal(found.means, SCENE.means)


def test_frames_behind_the_splats_are_told() -> None:
    frame = "element {} {}\nproperty ushort x\nproperty ushort y\nproperty ushort z\n"
    names = [("meta_delta_min_0", 1), ("meta_delta_max_0", 1), ("delta_vertex_0", 6), ("delta_vertex_1", 6)]
    more = "".join(frame.format(*each) for each in names).encode()
    found = read(PLAIN.replace(b"end_header", more + b"end_header") + bytes(6 * 14))
    assert found.left_out == ("movement (2 frames of elements delta_vertex_*)",)


def test_a_texture_coordinate_or_a_class_is_no_movement() -> None:
    assert read(with_property(with_property(PLAIN, "float t"), "float time")).left_out == ()


def test_features_for_an_mlp_are_no_colours() -> None:
    data = PLAIN
    for k in range(3, 9):
        data = with_property(data, f"float f_dc_{k}")
    with pytest.raises(InvalidFile, match=r"f_dc_0 to f_dc_8 are features for an MLP.*; allowed: colours"):
        read(data)


# -- the axis that points up -----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("comment", "up"),
    [
        ("Vertical Axis: z", "z"),
        ("Vertical axis: 0 0 1", "z"),
        ("vertical axis: -Y", "-y"),
        ("Vertical axis: 0 1 0", "y"),
        ("Vertical axis: 0 -1 0", "-y"),
        ("Vertical axis: -1.0, 0.0, 0.0", "-x"),
        ("Vertical axis: [0.001, 0, -2.5e0]", "-z"),
        ("Vertical axis: y", None),  # a constant of Brush before its pull request 507
        ("Vertical axis:", None),
        ("Vertical axis: 0 0 0", None),
        ("Vertical axis: up", None),
        ("Vertical axis: 0 0 1 0", None),
        ("Vertical axis: 1e999 0 0", None),
    ],
)
def test_the_stated_axis(comment: str, up: str | None) -> None:
    found = read(commented("Generated by Nerfstudio 1.1.5", comment))
    assert (found.up, found.notes) == (up, ())


def test_a_direction_between_the_axes_is_told() -> None:
    found = read(commented("Vertical axis: 0 -0.7 0.7"))
    assert found.up is None
    assert "0 -0.7 0.7 as the vertical axis, which is none of x, y, z" in found.notes[0]


def test_the_stated_axis_turns_with_the_splats_and_is_written() -> None:
    stated = read(commented("Vertical axis: 0 0 1"))
    assert stated.flipped().up == "-z"
    assert stated.with_up("z").up == "-y"
    assert SCENE.with_up("x").up == "-y"
    slanted = np.array([[1.0, 0, 0, 0], [0, 0.6, -0.8, 0], [0, 0.8, 0.6, 0]])
    assert stated.transformed(slanted).up is None
    written = b"".join(ply.encode(stated))
    assert b"comment Vertical axis: 0 0 1\n" in written
    assert read(written).up == "z"
    assert b"Vertical" not in b"".join(ply.encode(stated.with_up("z")))  # -y is what programs expect


# -- coordinates of a map --------------------------------------------------------------------------------------
def test_doubles_far_from_0_keep_their_digits(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    places = SCENE.means.astype(np.float64) + UTM
    found = read(farther(PLAIN, UTM))
    assert np.abs(found.origin - UTM).max() < 2
    np.testing.assert_allclose(found.means + found.origin, places, rtol=0, atol=1e-6)
    save(tmp_path / "a.ply", found)
    rows: Any = plyfile.PlyData.read(io.BytesIO((tmp_path / "a.ply").read_bytes()))["vertex"]
    np.testing.assert_allclose(np.stack([rows[axis] for axis in "xyz"], axis=1), places, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(rows["f_dc_0"], SCENE.sh[:, 0, 0])
    back = load(tmp_path / "a.ply", Splats)
    np.testing.assert_array_equal(back.origin, found.origin)
    np.testing.assert_allclose(back.means, found.means, atol=1e-8)


def test_doubles_near_0_are_read_as_before() -> None:
    shift = np.array([3.3, 0, 1 / 3])
    found = read(farther(PLAIN, shift))
    assert not found.origin.any()
    np.testing.assert_array_equal(found.means, (SCENE.means.astype(np.float64) + shift).astype(np.float32))


def test_the_compressed_kind_between_double_bounds_keeps_its_digits() -> None:
    scene = splats(20, degree=0)
    data = packed_ply(scene)
    at = data.index(b"end_header\n") + 11
    bounds = np.frombuffer(data, "<f4", 18, at).astype("<f8")
    bounds[:6] += np.tile(UTM, 2)
    found = read(data[:at].replace(b"property float", b"property double") + bounds.tobytes() + data[at + 72 :])
    np.testing.assert_allclose(found.means + found.origin, read(data).means + UTM, rtol=0, atol=1e-6)


def test_an_origin_turns_and_scales_with_the_splats() -> None:
    far = read(farther(PLAIN, UTM))
    places = far.means + far.origin
    np.testing.assert_array_equal(far.flipped().origin, far.origin * [1, -1, -1])
    turned = far.with_up("z")
    np.testing.assert_allclose(
        turned.means + turned.origin, places @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-6
    )
    moved = far.transformed(np.column_stack([2 * np.eye(3), [1, 2, 3]]))
    np.testing.assert_allclose(moved.means + moved.origin, 2 * places + [1, 2, 3], rtol=0, atol=1e-5)
    np.testing.assert_allclose(far.relative_to(np.zeros(3)).means, places, rtol=1e-7)


# -- text without rows -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("element", ["vertex", "chunk", "sh"])
def test_text_without_rows_is_told_as_in_binary(element: str) -> None:
    names = {"vertex": ["uint packed_position"], "chunk": ["float min_x"], "sh": ["uchar f_rest_0"]}
    if element == "vertex":
        head = text_ply(SCENE).partition(b"end_header\n")[0].replace(b"vertex 6", b"vertex 0") + b"end_header\n"
        told = "the splats have no rows"
    else:
        kinds = [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
        elements = {element: (0, names[element]), "vertex": (1, kinds)}
        head = ply_text(elements).replace(b"binary_little_endian", b"ascii") + b"0 0 0 0\n"
        told = "element chunk has 0 rows"
    with pytest.raises(NerfbakeError, match=told):
        read(head)


@pytest.mark.data
def test_the_files_of_the_reports(data: Path) -> None:
    reports = data / "reports"
    moving = load(reports / "F4_moving_splats/stg_lite.ply", Splats)
    assert moving.left_out
    assert load(reports / "F4_moving_splats/brush4d.ply", Splats).left_out
    halves = load(reports / "F6_half_ply/half_ushort.ply", Splats)
    assert (halves.n, halves.dropped) == (800, 0)
    assert float(np.abs(halves.sh[:, 1:]).max()) == pytest.approx(0.260254, abs=1e-6)
    assert load(reports / "F7_up_axis/nerfstudio.ply", Splats).up == "z"
    assert load(reports / "F7_up_axis/brush_old.ply", Splats).up is None
    far = load(reports / "F3_far_from_origin/geo_double.ply", Splats)
    raw = (reports / "F3_far_from_origin/geo_double.ply").read_bytes()
    at = raw.index(b"end_header\n") + 11
    first = struct.unpack_from("<3d", raw, at)
    np.testing.assert_allclose(far.means[0] + far.origin, first, rtol=0, atol=1e-6)
    assert len(np.unique(far.means[:, 1])) == 544
