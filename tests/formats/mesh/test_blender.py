"""Blender as the other program: meshes that it writes are seen where it renders them itself, from the same camera."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Meshes, load, render_meshes, save
from nerfbake.formats.mesh import glb as meshes_glb
from tests.support.meshes import camera, cube, mesh, sphere
from tests.support.vdb_readers import tool, tree, volume

_SCRIPT = """
import bpy, json, sys
from mathutils import Matrix
folder, pose, angle, edge = json.loads(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_monkey_add(size=1, location=(0.3, 0.2, 0.1), rotation=(0.3, 0.2, 0.9))
bpy.ops.object.empty_add(location=(-0.2, 0, 0.2), rotation=(0, 0.5, 0))
parent = bpy.context.object
parent.scale = (0.5, 0.3, -0.4)
bpy.ops.mesh.primitive_cone_add(vertices=7, location=(-1, 0.5, 0))
bpy.context.object.parent = parent
bpy.ops.export_scene.gltf(filepath=folder + "/a.glb", export_format="GLB", export_yup=False)
bpy.ops.wm.obj_export(filepath=folder + "/a.obj", forward_axis="Y", up_axis="Z", export_materials=False)
view = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
view.matrix_world = Matrix(pose)
view.data.sensor_fit, view.data.angle = "HORIZONTAL", angle
scene = bpy.context.scene
scene.collection.objects.link(view)
scene.camera = view
scene.render.engine = "CYCLES"
scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 16, False
scene.render.resolution_x = scene.render.resolution_y = edge
scene.render.film_transparent = True
scene.render.filepath = folder + "/a.png"
bpy.ops.render.render(write_still=True)
pixels = list(bpy.data.images.load(folder + "/a.png").pixels)
print("ALPHA", ",".join(f"{alpha:.3f}" for alpha in pixels[3::4]))
"""


@pytest.mark.slow
@pytest.mark.tools
@pytest.mark.skipif(shutil.which("blender") is None, reason="no blender: `make tools` installs it")
@pytest.mark.skipif(os.environ.get("NERFBAKE_BLENDER") == "0", reason="left out: NERFBAKE_BLENDER=0")
def test_blenders_meshes_are_seen_where_blender_renders_them(tmp_path: Path) -> None:
    (tmp_path / "render.py").write_text(_SCRIPT)
    view = camera(96, 96, distance=4.0)
    asked = json.dumps([str(tmp_path), view.pose.tolist(), 2 * np.arctan(0.5 * view.width / view.fx), view.width])
    said = tool("blender", "--background", "--factory-startup", "--python", tmp_path / "render.py", "--", asked)
    alpha = np.array(said.partition("ALPHA ")[2].splitlines()[0].split(","), float).reshape(96, 96)[::-1]
    for name in ("a.glb", "a.obj"):
        seen = render_meshes(load(tmp_path / name, Meshes), view).alpha
        assert 0.05 < seen.mean() < 0.9
        assert (seen[alpha > 0.9] == 1).all()
        assert (seen[alpha < 0.1] == 0).all()


_PLACES = """
import bpy, sys
import numpy
numpy.bool = bool  # Debian's Blender 3.4 asks its importer's NumPy for an alias that 1.24 dropped
folder = sys.argv[-1]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=folder + "/a.glb")
bpy.ops.object.volume_import(filepath=folder + "/a.vdb", align="WORLD", location=(0, 0, 0), rotation=(0, 0, 0))
for thing in bpy.context.scene.objects:
    if thing.type == "VOLUME":
        assert thing.data.grids.load()
bpy.context.view_layer.update()
for thing in bpy.context.evaluated_depsgraph_get().objects:
    if thing.type in ("MESH", "VOLUME"):
        corners = [thing.matrix_world @ type(thing.location)(corner) for corner in thing.bound_box]
        low, high = ([end(corner[axis] for corner in corners) for axis in range(3)] for end in (min, max))
        print("BOX", thing.type, ",".join(f"{x:.4f}" for x in low + high))
"""


@pytest.mark.slow
@pytest.mark.tools
@pytest.mark.skipif(shutil.which("blender") is None, reason="no blender: `make tools` installs it")
@pytest.mark.skipif(os.environ.get("NERFBAKE_BLENDER") == "0", reason="left out: NERFBAKE_BLENDER=0")
def test_volume_and_mesh_of_one_scene_stand_in_one_place_in_blender(tmp_path: Path) -> None:
    # A box of whole leaves, no two of its edges or places alike, and the same box as triangles.
    edges, first = np.array([16, 24, 40]), np.array([8, 16, 32])
    scene = volume(tree(np.stack(np.unravel_index(np.arange(edges.prod()), edges), axis=1) + first))
    save(tmp_path / "a.vdb", scene)
    step, origin = np.diag(scene.transform[:, :3]), scene.transform[:, 3]
    low, high = origin + (first - 0.5) * step, origin + (first + edges - 0.5) * step
    box = cube(0.5)
    positions = ((box.positions + 0.5) * (high - low) + low).astype(np.float32)
    save(tmp_path / "a.glb", Meshes((replace(box, positions=positions),)), up="z")
    (tmp_path / "places.py").write_text(_PLACES)
    said = tool("blender", "--background", "--factory-startup", "--python", tmp_path / "places.py", "--", str(tmp_path))
    found = dict(line.split()[1:] for line in said.splitlines() if line.startswith("BOX"))
    boxes = {kind: np.array(numbers.split(","), float) for kind, numbers in found.items()}
    np.testing.assert_allclose(boxes["MESH"], [*low, *high], atol=1e-3)
    # Blender's box of a volume goes from the first sample to the last: half a voxel less on each side.
    np.testing.assert_allclose(boxes["VOLUME"], [*(low + step / 2), *(high - step / 2)], atol=1e-3)


_LOOKS = """
import bpy, sys
import numpy
numpy.bool = bool  # Debian's Blender 3.4 asks its importer's NumPy for an alias that 1.24 dropped
folder = sys.argv[-1]
for name in ("a.glb", "a.obj", "a.ply"):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if name == "a.glb":
        bpy.ops.import_scene.gltf(filepath=folder + "/" + name)
    elif name == "a.obj":
        bpy.ops.wm.obj_import(filepath=folder + "/" + name, forward_axis="Y", up_axis="Z")
    else:
        bpy.ops.import_mesh.ply(filepath=folder + "/" + name)
    (thing,) = (each for each in bpy.context.scene.objects if each.type == "MESH")
    corners = [thing.matrix_world @ type(thing.location)(corner) for corner in thing.bound_box]
    low, high = ([end(corner[axis] for corner in corners) for axis in range(3)] for end in (min, max))
    pictures = [list(image.size) for image in bpy.data.images if image.has_data or image.size[0]]
    colours = len(thing.data.color_attributes)
    print("LOOK", name, len(thing.data.polygons), pictures, colours, *(f"{x:.4f}" for x in low + high), sep="|")
"""


@pytest.mark.slow
@pytest.mark.tools
@pytest.mark.skipif(shutil.which("blender") is None, reason="no blender: `make tools` installs it")
@pytest.mark.skipif(os.environ.get("NERFBAKE_BLENDER") == "0", reason="left out: NERFBAKE_BLENDER=0")
def test_blender_opens_textured_meshes_where_they_are(tmp_path: Path) -> None:
    ball = sphere(12, 16)
    ball = replace(ball, positions=(ball.positions * [1, 2, 0.5] + [3, 4, 5]).astype(np.float32))
    uvs = ((ball.positions[:, :2] - [2, 2]) / [2, 4]).clip(0, 1).astype(np.float32)
    textured = replace(ball, uvs=uvs, texture=np.full((16, 8, 3), (200, 120, 40), np.uint8))
    save(tmp_path / "a.glb", Meshes((textured,)), up="z", quantised=True, image="jpeg")
    save(tmp_path / "a.obj", Meshes((textured,)))
    save(tmp_path / "a.ply", Meshes((replace(ball, colours=np.full((len(ball.positions), 3), 0.5, np.float32)),)))
    (tmp_path / "look.py").write_text(_LOOKS)
    said = tool("blender", "--background", "--factory-startup", "--python", tmp_path / "look.py", "--", str(tmp_path))
    looks = [line.split("|")[1:] for line in said.splitlines() if line.startswith("LOOK")]
    assert [look[0] for look in looks] == ["a.glb", "a.obj", "a.ply"]
    for name, triangles, pictures, colours, *corners in looks:
        assert int(triangles) == len(ball.faces)
        assert (pictures, colours) == (("[]", "1") if name == "a.ply" else ("[[8, 16]]", "0"))
        np.testing.assert_allclose(np.array(corners, float), [2, 2, 4.5, 4, 6, 5.5], atol=1e-3)


def test_a_mesh_that_was_turned_for_gltf_comes_back() -> None:
    box = Meshes((mesh([[0, 0, 0], [1, 0, 0], [0, 2, 3]], [[0, 1, 2]]),))
    upright = meshes_glb.decode(memoryview(b"".join(meshes_glb.encode(box, up="z"))))
    assert upright.meshes[0].positions.tolist() == [[0, 0, 0], [1, 0, 0], [0, 3, -2]]
    np.testing.assert_array_equal(upright.with_up("z").meshes[0].positions, box.meshes[0].positions)
