"""Snapshots of instant-ngp: formulas, containers, occupancy, cameras, what is refused. No real one was to be had."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import FunctionField, load
from nerfbake.errors import MemoryLimit, NerfbakeError
from nerfbake.formats.field import instant_ngp as reader
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import look_at
from tests.support.hostile import refused_as_it_is
from tests.support.snapshots import CELLS, OFFSET, SCALE, morton, reference, snapshot, snapshot_file, to_ngp

POINTS = np.random.default_rng(0).uniform(-4, 4, (200, 3))
DIRECTIONS = fibonacci(200)


def read(root: dict[str, Any] | None = None) -> FunctionField:
    return reader.decode(memoryview(snapshot_file(root)))


def trained(points: Any) -> Any:
    """Of points of transforms.json: scaled, moved, and (x, y, z) is the (y, z, x) of the world."""
    return (points * SCALE + np.array(OFFSET))[:, [1, 2, 0]]


@pytest.fixture(scope="module")
def field() -> FunctionField:
    return read()


def test_values_follow_the_formula_in_the_world_of_transforms_json(field: FunctionField) -> None:
    """The colours take all 16 outputs, with the density, before the direction, which turns with the axes."""
    q = trained(POINTS)
    inside = ((q > -0.5) & (q < 1.5)).all(axis=1)
    density, features = field.density(POINTS)
    expected, colours = reference(q[inside], DIRECTIONS[inside][:, [1, 2, 0]])
    assert 20 < inside.sum() < 200
    assert_allclose(density[inside], SCALE * expected, rtol=5e-5)
    assert not density[~inside].any()
    assert_allclose(field.colour(features[inside], DIRECTIONS[inside]), colours, atol=5e-6)
    assert field.background == (0.25, 0.5, 0.75)
    assert (field.cameras, field.notes) == (None, ())


# Printed by C with glibc: exp(log(2048.0f * (float)A / (float)16u) / (16u - 1)).
GROWTHS = {1: "0x1.61c50ap+0", 2: "0x1.72803cp+0", 4: "0x1.8406p+0", 8: "0x1.965feap+0", 16: "0x1.a99804p+0"} | {
    32: "0x1.bdb8cep+0",
    64: "0x1.d2cd48p+0",
    128: "0x1.e8e1p+0",
}


@pytest.mark.parametrize("A", GROWTHS)
def test_the_factor_between_levels_is_computed_from_aabb_scale_in_float32(A: int) -> None:
    root = {"otype": "HashGrid", "n_levels": 16, "log2_hashmap_size": 19, "base_resolution": 16}
    assert reader._grid(root, A).growth == float.fromhex(GROWTHS[A])
    assert reader._grid(root | {"per_level_scale": 1.5}, A).growth == 1.5
    assert reader._grid({**root, "base_resolution": 0}, A).base == 64  # 2^(19 / 3)


@pytest.mark.parametrize("container", ["gzip", "zlib", "bare", "float", "JSON"])
def test_containers_give_the_same_field(container: str, field: FunctionField) -> None:
    root = snapshot(half=container != "float")
    if container == "JSON":
        stored = root["snapshot"]
        stored["params_binary"] = {"bytes": list(stored["params_binary"]), "subtype": None}
    packers: dict[str, Any] = {"gzip": gzip.compress, "zlib": zlib.compress}
    packed = packers.get(container, bytes)(snapshot_file(root))
    assert reader.recognise(memoryview(packed)) == (container != "zlib")
    found = reader.decode(memoryview(packed))
    assert_array_equal(found.density(POINTS)[0], field.density(POINTS)[0])


def test_files_are_found_by_their_contents_too(tmp_path: Path) -> None:
    data = gzip.compress(snapshot_file(), 1)
    for name in ("a.ingp", "a.msgpack", "a", "a.ingp.gz"):
        (tmp_path / name).write_bytes(data)
        assert load(tmp_path / name, FunctionField).dialect == "instant-ngp"
    for other in (b"", b"\x1f\x8b\x08", b"\x85\xa9optimizer", b"\x80"):
        assert not reader.recognise(memoryview(other))


def test_cells_are_in_morton_order_and_cascades_are_nested() -> None:
    """Cell (1, 2, 3) of the inner cube and (0, 9, 127) of the outer one; what no camera saw is -1."""
    grid = np.full((2, CELLS), -1.0)
    grid[0, morton(1, 2, 3)] = grid[1, morton(0, 9, 127)] = 0.5
    field = read(snapshot(grid=grid))
    assert field.occupied is not None
    cells, boxes = field.occupied
    assert np.argwhere(cells).tolist() == [[0, 1, 2, 3], [1, 0, 9, 127]]
    assert_array_equal(boxes[:, :, 0], [[0, 1], [-0.5, 1.5]])
    inner, outer = (np.array([1, 2, 3]) + 0.5) / 128, (np.array([0, 9, 127]) + 0.5) / 64 - 0.5
    density = field.in_trained_world().density(np.stack([inner, inner + 0.01, outer, outer + 0.5]))[0]
    assert (density > 0).tolist() == [True, False, True, False]


def test_a_cell_is_occupied_above_the_mean_or_a_hundredth() -> None:
    """The mean is of the positive values of the first cascade; the values are optical thickness, not density."""
    thin = np.zeros((2, CELLS))
    thin[0, :4], thin[0, 4:8], thin[1, 0] = (1e-3, 2e-4, 1e-6, -1), 0.25, 2e-6
    mean = (1e-3 + 2e-4 + 1e-6 + 1) / CELLS
    assert 1e-7 < mean < 1e-6
    for values, count in ((thin, 8), (np.full((2, CELLS), 0.011), 2 * CELLS), (np.full((2, CELLS), 0.009), 0)):
        occupied = read(snapshot(grid=values)).occupied
        assert occupied is not None
        assert occupied.cells.sum() == count
    assert read(snapshot(grid=[])).occupied is None


def test_cameras_come_back_to_the_world_of_transforms_json() -> None:
    poses = [look_at(np.zeros(3), turn, 0.5, 3.0) for turn in (0.0, 2.0, 4.0)]
    lenses: list[Any] = [
        {"is_fisheye": False, "k1": 0.1, "k2": 0.0, "p1": 0.01, "p2": 0.0},
        {"is_fisheye": True, "k1": 0.1, "k2": 0.2, "k3": 0.0, "k4": 0.0},
        {"latlong": True},
    ]
    metadata = [
        {"focal_length": [50.0, 60.0], "principal_point": [0.5, 0.25], "resolution": [40, 20], "lens": lens}
        for lens in lenses
    ]
    metadata[0]["camera_distortion"] = metadata[0].pop("lens")  # its name until 2022
    xforms = [{"start": to_ngp(pose).tolist(), "end": to_ngp(pose).tolist()} for pose in poses]
    paths = ["/data/fox/images/0001.jpg", "/data/fox/images/0002.jpg", "x"]
    found = read(snapshot(dataset={"n_images": 3, "xforms": xforms, "metadata": metadata, "paths": paths}))
    assert found.cameras is not None
    assert found.cameras.names == ["0001", "0002"]
    assert found.cameras.notes == ("1 camera without a perspective or fisheye lens left out",)
    for camera, pose in zip(found.cameras.cameras, poses, strict=False):
        assert_allclose(camera.pose, pose, atol=1e-12)
        assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (40, 20, 50, 60, 20, 5)
    first, second = (camera.lens for camera in found.cameras.cameras)
    assert first is not None
    assert second is not None
    assert (first.model, first.k, first.p, second.model) == ("polynomial", (0.1,), (0.01, 0.0), "fisheye")
    with_axes = read(snapshot(dataset={"from_mitsuba": True}))
    assert_allclose(with_axes.frame, np.column_stack([SCALE * np.eye(3), OFFSET]))


def test_settings_of_the_viewer() -> None:
    cut = {"min": [0.0, 0.25, -9.0], "max": [1.0, 0.75, 9.0]}
    found = read(snapshot(render_aabb=cut, exposure=1.0, dataset={"envmap_resolution": [64, 32]}))
    assert_array_equal(found.box, [[0, 0.25, -0.5], [1, 0.75, 1.5]])
    assert [note.split()[:2] for note in found.notes] == [["what", "is"], ["the", "exposure"], ["the", "environment"]]
    assert found.unit is not None
    assert_array_equal(found.unit, [[-0.5] * 3, [1.5] * 3])
    bare = snapshot()
    del bare["snapshot"]["nerf"]["dataset"], bare["snapshot"]["background_color"], bare["snapshot"]["mode"]
    found = read(bare)
    assert found.scale == pytest.approx(0.33)
    assert "no data set" in found.notes[0]
    assert found.background is None


def _changed(*path: str, to: Any) -> dict[str, Any]:
    root = snapshot(grid=[])
    place = root
    for key in path[:-1]:
        place = place[key]
    if to is None:
        del place[path[-1]]
    else:
        place[path[-1]] = to
    return root


_FACTS = ("snapshot", "nerf", "dataset")
REFUSED: dict[str, tuple[tuple[str, ...], Any, str]] = {
    "another mode": (("snapshot", "mode"), "sdf", "snapshot.mode is sdf; allowed: nerf"),
    "another version": (("snapshot", "version"), 2, "snapshot.version is 2; allowed: 1"),
    "no snapshot": (("snapshot",), None, "snapshot is missing"),
    "linear colours": ((*_FACTS, "is_hdr"), True, "is_hdr is True: colours are linear"),
    "an appearance per picture": ((*_FACTS, "n_extra_learnable_dims"), 16, "n_extra_learnable_dims is 16"),
    "no power of two": ((*_FACTS, "aabb_scale"), 3, "aabb_scale is 3; allowed: a power of two"),
    "a huge box": ((*_FACTS, "aabb_scale"), 1 << 40, "allowed: a whole number from 1 to 128"),
    "no scale": ((*_FACTS, "scale"), 0.0, "dataset.scale is 0"),
    "an offset of two": ((*_FACTS, "offset"), [0.5, 0.5], "offset has shape (2,)"),
    "2^63 rows": (("encoding", "log2_hashmap_size"), 63, "log2_hashmap_size is 63; allowed: a whole number from 1"),
    "2^30 rows": (("encoding", "log2_hashmap_size"), 30, "numbers; allowed: "),
    "a thousand levels": (("encoding", "n_levels"), 1000, "encoding.n_levels is 1000"),
    "levels of 2^40 nodes": (("encoding", "per_level_scale"), 1e6, "nodes along an axis; allowed: below"),
    "another encoding": (("encoding", "otype"), "Frequency", "encoding.otype is Frequency; allowed: hashgrid, grid"),
    "dense levels": (("encoding", "type"), "Dense", "encoding.type is Dense; allowed: hash"),
    "another interpolation": (("encoding", "interpolation"), "Smoothstep", "is Smoothstep; allowed: linear"),
    "another code of directions": (("dir_encoding",), {"otype": "OneBlob"}, "dir_encoding.otype is OneBlob"),
    "harmonics of degree 3": (
        ("dir_encoding",),
        {"otype": "SphericalHarmonics", "degree": 3},
        "dir_encoding.degree is 3; allowed: 4",
    ),
    "another activation": (("network", "activation"), "SnakeAct", "network.activation is SnakeAct; allowed: relu"),
    "wider layers": (("network", "n_neurons"), 64, "snapshot.params_binary has"),
    "too few parameters": (("snapshot", "params_binary"), bytes(20), "has 10 numbers; allowed: 3,072"),
    "parameters that are text": (("snapshot", "params_binary"), "abc", "snapshot.params_binary is text"),
    "parameters of 8 bits": (("snapshot", "params_type"), "fp8", "snapshot.params_type is fp8"),
    "half a number": (("snapshot", "params_binary"), bytes(21), "has 21 bytes; allowed: a multiple of 2"),
    "another grid": (("snapshot", "density_grid_size"), 64, "density_grid_size is 64; allowed: 128"),
    "a cascade too few": (
        ("snapshot", "density_grid_binary"),
        bytes(2 * CELLS),
        "has 2,097,152 cells; allowed: 4,194,304, for 2 cascades",
    ),
    "cameras that are not there": ((*_FACTS, "n_images"), 5, "xforms has null; allowed: 5 objects"),
    "cameras without end": ((*_FACTS, "n_images"), 1 << 31, "the frames are 2,147,483,648"),
    "a background of text": (("snapshot", "background_color"), ["a", "b", "c", "d"], "is not a table of numbers"),
    "a box elsewhere": (
        ("snapshot", "render_aabb"),
        {"min": [5.0, 5.0, 5.0], "max": [6.0, 6.0, 6.0]},
        "is outside of the trained box",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_read_is_refused(what: str) -> None:
    path, value, said = REFUSED[what]
    with memory_limit(16 << 20), pytest.raises(NerfbakeError) as error:
        read(_changed(*path, to=value))
    assert said in str(error.value)
    assert len(str(error.value)) <= 300


def test_streams_that_inflate_without_end_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = snapshot_file(_changed("snapshot", to=None))
    for pack in (gzip.compress, zlib.compress):
        bomb = pack(start + bytes(20 << 20))
        with memory_limit(8 << 20), pytest.raises(MemoryLimit):
            reader.decode(memoryview(bomb))
    whole = snapshot_file(snapshot(grid=[]))
    for data in (gzip.compress(whole)[:-9], zlib.compress(whole)[:-5], whole[:-100], whole + b"x", b"\x1f\x8b\x08\x00"):
        assert refused_as_it_is(tmp_path / "bad.ingp", data, capsys)


def test_weights_that_are_not_finite_are_problems() -> None:
    root = snapshot(grid=[])
    numbers = np.frombuffer(root["snapshot"]["params_binary"], "<f2").copy()
    numbers[[0, 600, -1]] = np.nan, np.inf, np.nan
    root["snapshot"]["params_binary"] = numbers.tobytes()
    assert len(read(root).problems()) == 3
