#!/usr/bin/env bash
# nerfstudio 1.1.5: the lens of a Metashape camera loses b1, and its p1 and p2 change places.
#
# Metashape's p1 goes with r^2 + 2x^2 in x, which is OpenCV's p2; b1 is the difference between fx and fy. The importer
# of cameras.xml copies p1 and p2 by name into a transforms.json of the model OPENCV, and writes f for both focal
# lengths. No number is missing or out of range, so nothing is said. With p1 = 0.002 and b1 = 10, as a drone's camera
# can have, a point near the corner is 8 pixels away from where Metashape puts it.
#
# Seen on 2026-11-28 (the pixel of the camera's point (0.5, 0.4, 1); 4000 x 3000 pixels, f = 3000):
#   transforms.json: {'camera_model': 'OPENCV', 'fl_x': 3000.0, 'fl_y': 3000.0, 'p1': 0.002, 'p2': 0.0}
#   Metashape: [3510.5 2702.4], OpenCV with transforms.json: [3502.4 2704.4]
#   distance: 8.3 pixels
#
# Only the function of the importer runs: the other packages of nerfstudio are not installed. nerfbake exchanges p1 and
# p2, and reads fx = f + b1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check --no-deps nerfstudio==1.1.5
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 opencv-python-headless==5.0.0.93 rich==14.1.0 \
    imageio==2.38.1 2>/dev/null
cat >cameras.xml <<'XML'
<document version="2.0.0"><chunk label="chunk" enabled="true">
<sensors next_id="1"><sensor id="0" label="sensor" type="frame"><resolution width="4000" height="3000"/>
<calibration type="frame" class="adjusted"><resolution width="4000" height="3000"/>
<f>3000</f><b1>10</b1><p1>0.002</p1><p2>0</p2></calibration></sensor></sensors>
<components next_id="1" active_id="0"><component id="0" label="component"/></components>
<cameras next_id="1"><camera id="0" sensor_id="0" component_id="0" label="a">
<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>
XML
venv/bin/python - <<'PYTHON'
import json
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

sys.modules |= {name: ModuleType(name) for name in ("open3d", "rawpy")}  # imported, not used here
from nerfstudio.process_data.metashape_utils import metashape_to_json

metashape_to_json({"a": Path("a.jpg")}, Path("cameras.xml"), Path("."))
data = json.loads(Path("transforms.json").read_text())
lens = data | data["frames"][0]
print("transforms.json:", {name: lens[name] for name in ("camera_model", "fl_x", "fl_y", "p1", "p2")})
x, y = 0.5, 0.4
square = x * x + y * y
bent = x + 0.002 * (square + 2 * x * x), y + 2 * 0.002 * x * y  # the manual of Metashape, "Camera models"
metashape = np.array([2000 + bent[0] * (3000 + 10), 1500 + bent[1] * 3000])
matrix = np.array([[lens["fl_x"], 0, lens["cx"]], [0, lens["fl_y"], lens["cy"]], [0, 0, 1]])
bends = np.array([lens["k1"], lens["k2"], lens["p1"], lens["p2"], lens["k3"]])
opencv = cv2.projectPoints(np.array([[x, y, 1]]), np.zeros(3), np.zeros(3), matrix, bends)[0].ravel()
print(f"Metashape: {metashape.round(1)}, OpenCV with transforms.json: {opencv.round(1)}")
print(f"distance: {np.linalg.norm(metashape - opencv):.1f} pixels")
assert lens["camera_model"] == "OPENCV" and lens["fl_x"] == lens["fl_y"] == 3000
assert (lens["p1"], lens["p2"]) == (0.002, 0) and np.linalg.norm(metashape - opencv) > 5
PYTHON
