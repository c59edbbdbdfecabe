#!/usr/bin/env bash
# pyopf 1.4.1: a camera that looks straight down has no rotation in the images.txt that opf2colmap writes.
#
# OPF is the format of Pix4D's projects, and states rotations as three angles; with omega and phi of 0, a camera of a
# drone looks straight down. COLMAP's axes are half a turn about x from OPF's, so this camera's quaternion has a w of 0,
# and opf2colmap divides by w: x, y and z are NaN, whatever kappa is. NumPy prints a warning, the program ends with 0,
# and pycolmap refuses the whole model. A simulated flight consists of such cameras. A tilt of a millionth of a degree
# is too little for some, and leaves others a quaternion whose length is not 1. opf2nerf, of the same package, writes
# matrices, and they are right.
# Guess: both programs write the same rotation, since looking down is what most of OPF's cameras do.
#
# Seen on 2026-11-28 (omega, phi, kappa; the quaternion of images.txt; the direction of view in transforms_train.json):
#   0 0 0: not finite, down
#   0 0 30: not finite, down
#   0.5 0.3 30: 0.0049 0.9659 0.2588 -0.0014, down
#   90 0 0: 0.7071 0.7071 0.0000 0.0000, north
#   all 360 whole kappas, omega and phi of 0: 360 not finite
#   pycolmap 4.2.1: ValueError
#
# nerfbake reads no OPF; a quaternion that is not finite is an error in its reader of images.txt.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check pyopf==1.4.1 numpy==2.4.6 pillow tqdm pycolmap==4.2.1 2>/dev/null
cat >project.py <<'PYTHON'
"""Write a project with one camera for each line of angles, and two points that all of them see."""

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from PIL import Image
from pyopf.cameras import CalibratedCamera, CalibratedCameras, CalibratedSensor, CameraList, PerspectiveInternals
from pyopf.cameras import input_cameras as inputs
from pyopf.cameras.camera_list import CameraData
from pyopf.io import save
from pyopf.pointcloud.pcl import GlTFPointCloud, ImagePoints, Matches, Node, PointIndexRanges
from pyopf.project import Calibration, ProjectObjects
from pyopf.project.metadata import Metadata
from pyopf.project.types import CoreProjectItemType
from pyopf.uid64 import Uid64

ANGLES = [(0, 0, 0), (0, 0, 30), (0.5, 0.3, 30), (90, 0, 0)]
count, sensor = len(ANGLES), Uid64(int=7)
ids = [Uid64(int=100 + i) for i in range(count)]
lens = PerspectiveInternals(np.array([400.0, 300.0]), 800.0, np.zeros(3), np.zeros(2))
cameras = CalibratedCameras(
    [
        CalibratedCamera(ids[i], sensor, np.array(angles, float), np.array([10.0 * i, 20, 100]))
        for i, angles in enumerate(ANGLES)
    ],
    [CalibratedSensor(sensor, lens)],
)
captures = []
for i in range(count):
    Image.new("RGB", (800, 600)).save(f"{i}.png")
    camera = inputs.Camera(
        ids[i],
        next(iter(inputs.ModelSource)),
        inputs.DynamicPixelRange(0.5),
        next(iter(inputs.PixelType)),
        sensor,
    )
    now = datetime.now(timezone.utc)
    captures.append(
        inputs.Capture(Uid64(int=500 + i), [camera], None, ids[i], next(iter(inputs.RigModelSource)), now)
    )
band, shutter = inputs.BandInformation(1.0, "R"), next(iter(inputs.ShutterType))
device = inputs.Sensor(sensor, "camera", [band], np.array([800, 600]), lens, 2.4, shutter)
matches = Matches()
matches.camera_uids = ids
matches.camera_ids = np.array([*range(count), *range(count)], np.uint32).reshape(-1, 1)
matches.point_index_ranges = PointIndexRanges(np.zeros((2, 2), np.uint32))
matches.point_index_ranges[0], matches.point_index_ranges[1] = (0, count), (count, count)
matches.image_points = ImagePoints()
matches.image_points.featureIds = np.arange(2 * count, dtype=np.uint32).reshape(-1, 1)
matches.image_points.scales = np.ones((2 * count, 1), np.float32)
matches.image_points.pixelCoordinates = np.full((2 * count, 2), 5, np.float32)
node = Node()
node.position, node.matrix, node.matches = np.array([[0, 0, 0], [1, 2, 3]], np.float32), np.eye(4), matches
tracks = GlTFPointCloud()
tracks.nodes = [node]
calibration = Calibration(calibrated_cameras_objs=[cameras], point_cloud_objs=[tracks])
listed = CameraList([CameraData(uid, f"{i}.png") for i, uid in enumerate(ids)])
taken = inputs.InputCameras(captures, [device])
calibration.metadata = Metadata(type=CoreProjectItemType.CALIBRATION)
listed.metadata = Metadata(type=CoreProjectItemType.CAMERA_LIST)
taken.metadata = Metadata(type=CoreProjectItemType.INPUT_CAMERAS)
project = ProjectObjects()
project.calibration_objs, project.camera_list_objs, project.input_cameras_objs = [calibration], [listed], [taken]
save(project, Path("project.opf").absolute(), write_point_cloud_buffers=True)
PYTHON
venv/bin/python project.py
venv/bin/opf2colmap project.opf --out-dir colmap >log 2>&1
venv/bin/opf2nerf project.opf --out-dir nerf --output-extension >log 2>&1
venv/bin/python - <<'PYTHON' 2>log
import json
from math import isfinite
from pathlib import Path

import numpy as np
import pycolmap
from opf_tools.opf2colmap.converter import orient_pos_computation

frames = {frame["file_path"]: frame for frame in json.loads(Path("nerf/transforms_train.json").read_text())["frames"]}
lines = [line.split() for line in Path("colmap/images.txt").read_text().splitlines() if ".png" in line]
for line, angles, seen, view in zip(
    lines,
    ["0 0 0", "0 0 30", "0.5 0.3 30", "90 0 0"],
    ["not finite", "not finite", "0.0049 0.9659 0.2588 -0.0014", "0.7071 0.7071 0.0000 0.0000"],
    ["down", "down", "down", "north"],
    strict=True,
):
    turn = [float(word) for word in line[1:5]]
    found = " ".join(f"{number:.4f}" for number in turn) if all(map(isfinite, turn)) else "not finite"
    frame = next(frame for path, frame in frames.items() if Path(path).name == line[-1])
    x, y, z = np.round(-np.array(frame["transform_matrix"])[:3, 2], 1)
    direction = {(0, 0, -1): "down", (0, 1, 0): "north"}[x, y, z]
    print(f"{angles}: {found}, {direction}")
    assert (found, direction) == (seen, view)
turns = [orient_pos_computation(np.array([0.0, 0.0, kappa]), np.zeros(3))[0] for kappa in range(360)]
lost = sum(not np.isfinite(turn).all() for turn in turns)
print(f"all 360 whole kappas, omega and phi of 0: {lost} not finite")
assert lost == 360
try:
    pycolmap.Reconstruction("colmap")
except ValueError:
    print("pycolmap 4.2.1: ValueError")
else:
    raise AssertionError("pycolmap reads the model")
PYTHON
