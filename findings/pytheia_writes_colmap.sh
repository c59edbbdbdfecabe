#!/usr/bin/env bash
# pytheia 1.2.1: a camera that is exported to COLMAP gets its k1 twice, and the focal length of x for both axes.
#
# TheiaSfM's pinhole camera has a focal length, an aspect ratio, k1 and k2. WriteColmapFiles() makes it COLMAP's RADIAL,
# which has one focal length, k1 and k2: the second coefficient of the file is k1 again, and the aspect ratio is left
# out. The function returns True and prints nothing. With the numbers below, which a wide lens can have, the same point
# is almost 30 pixels away for COLMAP. WriteNerfStudio() writes all four numbers of the same camera.
# Guess: k1 and k2 arrive in their places, and a camera with two focal lengths is refused or becomes an OPENCV.
#
# Seen on 2026-11-28 (800 x 600 pixels; the last number is the distance between both projections of a point, in pixels):
#   k2: f 700 700, k1 0.1, k2 -0.05 -> 0 RADIAL 800 600 700 410 290 0.1 0.1, 6.3
#   aspect ratio: f 700 630, k1 0, k2 0 -> 0 RADIAL 800 600 700 410 290 0 0, 24.5
#   both: f 700 630, k1 0.1, k2 -0.05 -> 0 RADIAL 800 600 700 410 290 0.1 0.1, 29.5
#   transforms.json of the last one: fl 700 630, k1 0.1, k2 -0.05
#
# nerfbake reads the transforms.json of such a camera, and writes a lens with two focal lengths as OPENCV for COLMAP.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check pytheia==1.2.1 pycolmap==4.2.1 numpy==2.4.6 2>/dev/null
venv/bin/python - <<'PYTHON'
import json
from pathlib import Path

import numpy as np
import pycolmap
from pytheia import io, sfm

PLACE = np.array([0.45, 0.35, 1.0])  # in the frame of the camera: near a corner of the picture


def scene(focal, radial):
    """Two cameras without a rotation, and one point."""
    prior = sfm.CameraIntrinsicsPrior()
    prior.image_width, prior.image_height = 800, 600
    prior.camera_intrinsics_model_type = "PINHOLE"
    for name, value in (
        ("focal_length", [focal[0]]),
        ("aspect_ratio", [focal[1] / focal[0]]),
        ("principal_point", [410, 290]),
        ("radial_distortion", [*radial, 0, 0]),
        ("skew", [0]),
    ):
        field = getattr(prior, name)
        field.value, field.is_set = value, True
    built = sfm.Reconstruction()
    for i in range(2):
        view = built.MutableView(built.AddView(f"{i}.jpg", 0, float(i)))
        view.SetCameraIntrinsicsPrior(prior)
        view.MutableCamera().SetFromCameraIntrinsicsPriors(prior)
        view.MutableCamera().SetPosition(np.array([0.1 * i, 0, 0]))
        view.SetIsEstimated(True)
    point = built.AddTrack()
    built.MutableTrack(point).SetPoint(np.array([*PLACE, 1]))
    built.MutableTrack(point).SetIsEstimated(True)
    for i in built.ViewIds():
        pixel = built.View(i).Camera().ProjectPoint(built.Track(point).Point())[1]
        built.AddObservation(i, point, sfm.Feature(np.array(pixel)))
    return built


for name, focal, radial, away in (
    ("k2", (700, 700), (0.1, -0.05), 6.3),
    ("aspect ratio", (700, 630), (0, 0), 24.5),
    ("both", (700, 630), (0.1, -0.05), 29.5),
):
    built = scene(focal, radial)
    folder = Path(name)
    folder.mkdir()
    assert io.WriteColmapFiles(built, name)
    line = (folder / "cameras.txt").read_text().strip()
    theirs = pycolmap.Reconstruction(name).cameras[0].img_from_cam(PLACE)
    first = built.ViewIdFromName("0.jpg")
    ours = built.View(first).Camera().ProjectPoint(np.array([*PLACE, 1]))[1]
    found = round(float(np.linalg.norm(np.array(ours) - theirs)), 1)
    print(f"{name}: f {focal[0]} {focal[1]}, k1 {radial[0]}, k2 {radial[1]} -> {line}, {found}")
    assert line == f"0 RADIAL 800 600 700 410 290 {radial[0]} {radial[0]}"
    assert found == away
assert io.WriteNerfStudio("images", built, 16, "transforms.json")
frame = json.loads(Path("transforms.json").read_text())["frames"][0]
print(f"transforms.json of the last one: fl {frame['fl_x']:g} {frame['fl_y']:g}, k1 {frame['k1']}, k2 {frame['k2']}")
assert [frame[key] for key in ("fl_x", "fl_y", "k1", "k2")] == [700, 630, 0.1, -0.05]
PYTHON
