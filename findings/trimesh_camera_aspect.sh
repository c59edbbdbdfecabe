#!/usr/bin/env bash
# trimesh 5.2.0: a camera of 100 degrees is exported to glTF as one of 89.5: its aspectRatio is a ratio of angles.
#
# Camera.fov has two angles, across and down. The exporter writes the second one as yfov and the quotient of both as
# aspectRatio, which in glTF is the width of the view divided by its height: the quotient of their tangents. The wider
# the lens, the farther off. Right are only square pictures, and viewers that use the shape of their window instead.
#
# Seen on 2026-11-28, for 1920 x 1080 pixels (the camera's angle across; aspectRatio, and the angle that it means):
#   60 1.667 56.9
#   100 1.478 89.5
#
# nerfbake takes aspectRatio for what glTF defines, and a note says where pixels are not square by it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6 2>/dev/null
venv/bin/python - <<'PYTHON'
import json
from math import atan, degrees, radians, tan

import numpy as np
import trimesh

for across, ratio, wrong in ((60, 1.667, 56.9), (100, 1.478, 89.5)):
    focal = 1920 / 2 / tan(radians(across / 2))
    scene = trimesh.Scene(trimesh.creation.box())
    scene.camera = trimesh.scene.Camera(resolution=(1920, 1080), focal=(focal, focal))
    scene.camera_transform = np.eye(4)
    assert abs(scene.camera.fov[0] - across) < 1e-9
    optics = json.loads(scene.export(file_type="gltf")["model.gltf"])["cameras"][0]["perspective"]
    assert abs(tan(optics["yfov"] / 2) - 1080 / 2 / focal) < 1e-9
    meant = degrees(2 * atan(tan(optics["yfov"] / 2) * optics["aspectRatio"]))
    print(across, found := round(optics["aspectRatio"], 3), round(meant, 1))
    assert (found, round(meant, 1)) == (ratio, wrong)
PYTHON
