from __future__ import annotations

import dataclasses
import os
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, build_octree_from_volume, build_vdb, load, sample_n3tree, save
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.volume import openvdb as vdb_openvdb
from nerfbake.formats.volume import openvdb_writer
from nerfbake.formats.wire.openvdb import text
from nerfbake.io import check
from nerfbake.memory import memory_limit
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.volume import Volume
from tests.support.scenes import assert_same_octree, n3tree
from tests.support.vdb_readers import SCENES, blosc_for_zip, by_coords, index, pyopenvdb, tool, transform, tree, volume

Codec = Literal["none", "zip"]
TYPES: dict[str, Any] = {
    "float": {},
    "half": {"dtype": np.float16},
    "vec3": {"channels": 3, "name": "Cd"},
    "half vec3": {"channels": 3, "name": "Cd", "dtype": np.float16},
}


def encoded(made: Volume, *, codec: Codec = "zip") -> bytes:
    return b"".join(vdb_openvdb.encode(made, codec=codec))


def decoded(data: bytes) -> Volume:
    return vdb_openvdb.decode(memoryview(data))


@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("scene", SCENES)
def test_what_is_written_is_read(scene: str, kind: str, codec: Codec) -> None:
    grid = tree(SCENES[scene], **TYPES[kind])
    data = encoded(volume(grid, tree(SCENES["one voxel"], name="other")), codec=codec)
    back = decoded(data)
    assert back.problems() == []
    read, other = back.grids
    assert (read.name, other.name) == (grid.name, "other")
    assert_array_equal(back.transform, transform())
    assert_array_equal(read.topology.coords, grid.topology.coords)
    assert read.values.dtype == grid.values.dtype
    assert read.values.tobytes() == grid.values.tobytes()
    assert encoded(back, codec=codec) == data


def test_backgrounds_names_and_transforms_are_kept() -> None:
    grid = tree(SCENES["a cloud"], background=-2.5, name="ü" * 300)
    for scale in ((0.25, 0.25, 0.25), (0.1, 0.2, 0.3), (1.0, -1.0, 1.0)):
        back = decoded(encoded(Volume((grid,), transform(scale=scale))))
        assert_array_equal(back.transform, transform(scale=scale))
        assert back.grids[0].name == "ü" * 300
        assert_array_equal(back.grids[0].background, [-2.5])
    turned = np.array([[0.5, 0, 0, 1], [0, 0, 0.5, 2], [0, -0.5, 0, 3]])
    assert_array_equal(decoded(encoded(Volume((grid,), turned))).transform, turned)


def test_a_grid_without_a_name_is_no_parent_of_the_next() -> None:
    """A grid whose parent is '' has voxels of its own; OpenVDB names the grid whose voxels it shares."""
    made = volume(tree([[0, 0, 0]], name=""), tree([[5, 6, 7], [9, 9, 9]], name="density"))
    back = decoded(encoded(made))
    assert [grid.topology.m for grid in back.grids] == [1, 2]


def test_the_octree_comes_back_from_density_and_sh() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    for half in (False, True):
        made = build_vdb(octree, grids=("density", "sh"), half=half)
        assert_same_octree(build_octree_from_volume(decoded(encoded(made))), build_octree_from_volume(made))


def test_there_are_no_index_grids() -> None:
    with pytest.raises(InvalidScene, match=r"a \.vdb has no index grids"):
        encoded(volume(index([])))


def test_memory_is_bounded_before_values_are_unpacked() -> None:
    with pytest.raises(MemoryLimit, match=r"grid 'density' needs 2\.0 KiB; allowed: 1000 B"), memory_limit(1000):
        vdb_openvdb.decode(memoryview(encoded(volume(tree(SCENES["a full leaf"])))))


def test_each_grid_keeps_its_transform() -> None:
    one, other = tree(SCENES["one voxel"]), tree(SCENES["a cloud"], name="other")
    elsewhere = transform(scale=(0.5, 0.5, 0.5))
    back = decoded(encoded(Volume((one, dataclasses.replace(other, place=elsewhere)), transform())))
    assert_array_equal(back.transforms, [transform(), elsewhere])
    assert_array_equal(back.only(["other"]).transforms, [elsewhere])


def test_version_225_of_openvdb_13_is_read() -> None:
    data = encoded(volume(tree(SCENES["a cloud"])))
    assert encoded(decoded(data[:8] + struct.pack("<I", 225) + data[12:])) == data


@pytest.mark.parametrize("kind", ["Tree_half_5_4_3", "Tree_vec3h_5_4_3"])
def test_a_grid_of_halves_of_openvdb_13_is_named(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid of halves is not one of floats that are saved as halves."""
    with monkeypatch.context() as patched:
        patched.setitem(openvdb_writer.TYPES, (1, "float16"), kind)
        grids = tree(SCENES["one voxel"]), tree(SCENES["a cloud"], name="heat", dtype=np.float16)
        both, alone = encoded(volume(*grids)), encoded(volume(grids[1]))
    (tmp_path / "a.vdb").write_bytes(both)
    said = f"grid 'heat' is a {kind}, a grid of halves as OpenVDB 13 writes it; allowed: floats saved as halves (Tree_"
    assert load(tmp_path / "a.vdb", Volume).labels == ["density"]
    (problem,) = check(tmp_path / "a.vdb")
    assert str(problem).startswith(said)
    with pytest.raises(InvalidFile) as caught:
        decoded(alone)
    assert str(caught.value).startswith(said)


def test_a_grid_in_a_cameras_frustum_leaves_the_others() -> None:
    data = encoded(volume(tree(SCENES["one voxel"]), tree(SCENES["a full leaf"], name="other")))
    at = data.rindex(b"UniformScaleTranslateMap")
    back = decoded(data[:at] + b"NonlinearFrustumMap".ljust(24) + data[at + 24 :])
    assert back.labels == ["density"]
    assert "grid 'other': the map is a NonlinearFrustumMap" in str(back.unread[0])
    with pytest.raises(InvalidFile, match="grid 'density': the map is a NonlinearFrustumMap"):
        decoded(data.replace(b"UniformScaleTranslateMap", b"NonlinearFrustumMap".ljust(24)))


def test_metadata_of_megabytes_are_passed_over() -> None:
    """OpenVDB 6 to 12 list the size of each leaf in `file_delayed_load`, with up to 9 bytes a leaf."""
    data = bytearray(encoded(volume(tree(SCENES["one voxel"]))))
    data[20] = 0  # a stream: the positions that follow mean nothing
    leaves = text("file_delayed_load") + text("__delayedload") + text(bytes(2 << 20))
    assert data[57:61] == bytes(4)
    data[57:61] = struct.pack("<I", 1) + leaves
    assert decoded(bytes(data)).grids[0].topology.m == 1
    with pytest.raises(InvalidFile, match="metadata 'file_delayed_load' would be at bytes"):
        decoded(bytes(data[: 1 << 20]))


# -- OpenVDB itself --------------------------------------------------------------------------------------------
@pytest.mark.tools
@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("scene", SCENES)
def test_openvdb_reads_every_voxel(scene: str, kind: str, codec: Codec, tmp_path: Path) -> None:
    grid = tree(SCENES[scene], **TYPES[kind], background=0.5)
    save(tmp_path / "a.vdb", volume(grid, tree(SCENES["a cloud"], name="other")), codec=codec)
    seen = pyopenvdb(tmp_path / "a.vdb")
    for written in (grid, tree(SCENES["a cloud"], name="other")):
        read = seen[written.name]
        assert by_coords(read.coords, read.values) == by_coords(written.topology.coords, written.values)
        assert_array_equal(read.background, written.background)
        assert_array_equal(read.transform, transform())
        assert read.type == ("vec3s" if written.values.shape[1] == 3 else "float")
        assert read.half == (written.values.dtype == np.float16)
        assert read.grid_class == ("unknown" if written.values.shape[1] == 3 else "fog volume")


@pytest.mark.tools
@pytest.mark.parametrize("scale", [(0.1, 0.2, 0.3), (0.5, -0.5, 0.5)])
def test_openvdb_puts_it_where_it_is(scale: tuple[float, float, float], tmp_path: Path) -> None:
    save(tmp_path / "a.vdb", Volume((tree(SCENES["one voxel"]),), transform(scale=scale)))
    assert_allclose(pyopenvdb(tmp_path / "a.vdb")["density"].transform, transform(scale=scale), rtol=1e-15)
    turned = np.array([[0.5, 0, 0, 1], [0, 0, 0.5, 2], [0, -0.5, 0, 3]])
    save(tmp_path / "b.vdb", Volume((tree(SCENES["one voxel"]),), turned))
    assert_array_equal(pyopenvdb(tmp_path / "b.vdb")["density"].transform, turned)


@pytest.mark.tools
def test_vdb_print_sees_the_levels(tmp_path: Path) -> None:
    grid = tree(SCENES["a cloud"], name="d" * 300)
    save(tmp_path / "a.vdb", volume(grid))
    said = tool("vdb_print", "-l", tmp_path / "a.vdb")
    upper, lower, leaves = grid.topology.node_counts
    assert f"Root(1 x {upper}), Internal({upper} x 32^3), Internal({lower} x 16^3), Leaf({leaves:,} x 8^3)" in said
    assert "Name: " + "d" * 300 in said


_COPY = """
import sys, numpy, pyopenvdb
rng = numpy.random.default_rng(0)
grids = []
for name, kind, shape in (("density", pyopenvdb.FloatGrid, (40, 30, 20)), ("Cd", pyopenvdb.Vec3SGrid, (40, 30, 20, 3))):
    grid = kind()
    grid.name = name
    dense = numpy.where(rng.random((40, 30, 20)) < 0.3, 1, 0).astype("f4")
    dense = (dense.T * rng.random(shape).T).T.astype("f4")
    grid.copyFromArray(dense, ijk=(-13, 5, 4090))
    grid.saveFloatAsHalf = len(sys.argv) > 3
    numpy.save(f"{sys.argv[2]}_{name}.npy", dense)
    grids.append(grid)
pyopenvdb.write(sys.argv[1], grids=grids)
"""


@pytest.mark.tools
@pytest.mark.parametrize("half", [False, True])
def test_what_openvdb_writes_is_read(half: bool, tmp_path: Path) -> None:
    """As it writes unless told otherwise: active values only, packed by blosc."""
    arguments = [str(tmp_path / "a.vdb"), str(tmp_path / "dense"), *(["half"] if half else [])]
    subprocess.run(["/usr/bin/python3", "-c", _COPY, *arguments], check=True)
    read = load(tmp_path / "a.vdb", Volume)
    assert read.problems() == []
    for name in ("density", "Cd"):
        dense = np.load(tmp_path / f"dense_{name}.npy").reshape(40, 30, 20, -1)
        grid = read.grid(name)
        assert grid.values.dtype == (np.float16 if half else np.float32)
        found = np.zeros_like(dense)
        found[tuple((grid.topology.coords - [-13, 5, 4090]).T)] = grid.values
        assert_array_equal(found, dense.astype(grid.values.dtype))


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("scene", SCENES)
def test_blosc_is_read_as_zip_is(scene: str, kind: str) -> None:
    made = volume(tree(SCENES[scene], **TYPES[kind], background=0.5))
    with blosc_for_zip():
        data = encoded(made)
    back = decoded(data)
    assert encoded(back) == encoded(made)


def test_a_leaf_stored_whole_keeps_its_inactive_values() -> None:
    """Code 6, as OpenVDB writes where inactive values differ; the background among them is background."""
    data = bytearray(encoded(volume(tree([[0, 0, 0], [0, 0, 9]])), codec="none"))
    at = data.rindex((1).to_bytes(64, "little"))  # the first leaf's mask, before its values
    values = np.zeros(512, "<f4")
    values[:300] = np.arange(1000, 1300)
    whole = data[: at + 64] + b"\6" + values.tobytes() + data[at + 64 + 5 :]
    end = data.index(len(data).to_bytes(8, "little"))
    whole[end : end + 8] = len(whole).to_bytes(8, "little")
    (grid,) = decoded(bytes(whole)).grids
    assert isinstance(grid, VdbTree)
    assert_array_equal(grid.values[:, 0], [*values[:300], tree([[0, 0, 0], [0, 0, 9]]).values[1, 0]])
    assert grid.active is not None
    assert_array_equal(np.flatnonzero(grid.active), [0, 300])
    assert_array_equal(grid.active_topology.coords, [[0, 0, 0], [0, 0, 9]])


# -- Blender ---------------------------------------------------------------------------------------------------
_RENDER = """
import bpy, sys
from mathutils import Vector
source, target = sys.argv[sys.argv.index("--") + 1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.object.volume_import(filepath=source, align="WORLD")
volume = bpy.context.object
print("GRIDS", sorted(grid.name for grid in volume.data.grids) if volume.data.grids.load() else "none")
material = bpy.data.materials.new("emit")
material.use_nodes = True
nodes, links = material.node_tree.nodes, material.node_tree.links
nodes.clear()
output = nodes.new("ShaderNodeOutputMaterial")
volume_node = nodes.new("ShaderNodeVolumePrincipled")
volume_node.inputs["Emission Strength"].default_value = 3
volume_node.inputs["Density"].default_value = 1
links.new(volume_node.outputs[0], output.inputs["Volume"])
volume.data.materials.append(material)
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.type, camera.data.ortho_scale = "ORTHO", 4
camera.location = (0, 0, 5)
scene = bpy.context.scene
scene.collection.objects.link(camera)
scene.camera = camera
scene.render.engine = "CYCLES"
scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 4, False
scene.render.resolution_x = scene.render.resolution_y = 64
scene.render.film_transparent = True
scene.render.filepath = target
bpy.ops.render.render(write_still=True)
pixels = list(bpy.data.images.load(target).pixels)
alpha = pixels[3::4]
print("ALPHA", ",".join(f"{value:.3f}" for value in alpha))
"""


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.tools
@pytest.mark.skipif(shutil.which("blender") is None, reason="no blender: `make tools` installs it")
@pytest.mark.skipif(os.environ.get("NERFBAKE_BLENDER") == "0", reason="left out: NERFBAKE_BLENDER=0")
def test_blender_shows_it_where_it_is(tmp_path: Path) -> None:
    """From above, orthographic: opaque where the grid has density below a pixel, clear where it has none."""
    made = build_vdb(build_octree(sample_n3tree(resolution=32)))
    shifted = made.transform.copy()
    shifted[:2, 3] += [0.6, -0.3]  # so that a mirrored or a centred picture is wrong
    save(tmp_path / "a.vdb", Volume(made.grids, shifted))
    (tmp_path / "render.py").write_text(_RENDER)
    arguments = ["--background", "--factory-startup", "--python", str(tmp_path / "render.py"), "--"]
    said = tool("blender", *arguments, tmp_path / "a.vdb", tmp_path / "a.png")
    assert "GRIDS ['Cd', 'density']" in said
    alpha = np.array(said.partition("ALPHA ")[2].splitlines()[0].split(","), float).reshape(64, 64)  # rows upwards
    density = made.grid("density")
    assert isinstance(density, VdbTree)
    # Pixel (row, column) looks down at x = (column + 0.5) / 16 - 2, y = (row + 0.5) / 16 - 2.
    looks_at = (np.arange(64) + 0.5) / 16 - 2
    column, row = (np.rint((looks_at - shifted[axis, 3]) / made.voxel_size[axis]).astype(int) for axis in (0, 1))
    columns = np.zeros((200, 200), bool)  # of voxels that hold something
    columns[density.topology.coords[:, 1] + 80, density.topology.coords[:, 0] + 80] = True
    below = columns[np.ix_(row + 80, column + 80)]
    seen = alpha > 0.5
    assert 0.1 < below.mean() < 0.9
    # The outline may go either way: densities fall off there.
    assert np.count_nonzero(seen & below) / np.count_nonzero(seen | below) > 0.85
