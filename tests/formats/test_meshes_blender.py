"""Blender as the other program: meshes that it writes are seen where it renders them itself, from the same camera."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Meshes, draw, load
from tests.meshes import camera
from tests.vdb_readers import tool

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
@pytest.mark.skipif(shutil.which("blender") is None, reason="no blender: `make tools` installs it")
@pytest.mark.skipif(os.environ.get("NERFBAKE_BLENDER") == "0", reason="left out: NERFBAKE_BLENDER=0")
def test_blenders_meshes_are_seen_where_blender_renders_them(tmp_path: Path) -> None:
    (tmp_path / "render.py").write_text(_SCRIPT)
    view = camera(96, 96, distance=4.0)
    asked = json.dumps([str(tmp_path), view.pose.tolist(), 2 * np.arctan(0.5 * view.width / view.fx), view.width])
    said = tool("blender", "--background", "--factory-startup", "--python", tmp_path / "render.py", "--", asked)
    alpha = np.array(said.partition("ALPHA ")[2].splitlines()[0].split(","), float).reshape(96, 96)[::-1]
    for name in ("a.glb", "a.obj"):
        seen = draw(load(tmp_path / name, Meshes), view).alpha
        assert 0.05 < seen.mean() < 0.9
        assert (seen[alpha > 0.9] == 1).all()
        assert (seen[alpha < 0.1] == 0).all()
