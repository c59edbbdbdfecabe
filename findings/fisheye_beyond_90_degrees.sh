#!/usr/bin/env bash
# pycolmap 4.2.1: pixels of a fisheye that look backwards are given a ray at 58 degrees, and no error.
#
# A fisheye of more than 180 degrees sees past 90 degrees from its axis, and cam_ray_from_img() "supports back-facing
# rays of omnidirectional cameras". It does for EQUIRECTANGULAR. The seven fisheye models give a pixel at 91 degrees the
# ray of one at 58 degrees: nothing is NaN, and two pixels share a ray. The other way, img_from_cam() answers NaN for a
# point at 91 degrees to the right, or, with check_cheirality=False, a pixel near the left edge. So a trainer that asks
# pycolmap for rays gets wrong ones along the rim of such a picture.
#
# Seen on 2026-11-28 (angle of the pixel, angles of the rays of a fisheye and of EQUIRECTANGULAR, in degrees):
#   60.0 60.0 60.0
#   89.0 89.0 89.0
#   91.0 57.8 91.0
#   95.0 58.9 95.0
#   the point at 91 degrees: [nan nan], without the check [ 34. 500.]; its pixel is [976.5 500]
#
# nerfbake's fisheye has rays up to 180 degrees from the axis.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pycolmap

ANGLES = np.array([60.0, 89, 91, 95])


def angles(model, numbers, size, per_radian):
    """The angles from the axis at which the rays of pixels to the right of the centre look, in degrees."""
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=numbers)
    pixels = np.stack([size[0] / 2 + per_radian * np.radians(ANGLES), np.full(4, size[1] / 2)], axis=1)
    assert (pixels < size).all()
    rays = np.asarray(camera.cam_ray_from_img(pixels))
    return np.degrees(np.arctan2(rays[:, 0], rays[:, 2])).round(1)


whole = angles("EQUIRECTANGULAR", [1000, 500], (1000, 500), 1000 / (2 * np.pi))
assert whole.tolist() == ANGLES.tolist()
focal, centre = [300], [500, 500]
fisheyes = {
    "SIMPLE_FISHEYE": [*focal, *centre],
    "FISHEYE": [*focal * 2, *centre],
    "SIMPLE_RADIAL_FISHEYE": [*focal, *centre, 0],
    "RADIAL_FISHEYE": [*focal, *centre, 0, 0],
    "OPENCV_FISHEYE": [*focal * 2, *centre, *[0] * 4],
    "THIN_PRISM_FISHEYE": [*focal * 2, *centre, *[0] * 8],
    "RAD_TAN_THIN_PRISM_FISHEYE": [*focal * 2, *centre, *[0] * 12],
}
for model, numbers in fisheyes.items():
    found = angles(model, numbers, (1000, 1000), 300)
    assert found.tolist() == [60, 89, 57.8, 58.9], (model, found)
for row in zip(ANGLES, found, whole, strict=True):
    print(*row)
camera = pycolmap.Camera(model="FISHEYE", width=1000, height=1000, params=fisheyes["FISHEYE"])
behind = np.array([np.sin(np.radians(91)), 0, np.cos(np.radians(91))])[None]
checked, free = (np.asarray(camera.img_from_cam(behind, check_cheirality=check))[0] for check in (True, False))
print(f"the point at 91 degrees: {checked}, without the check {free.round(1)}; its pixel is [976.5 500]")
assert np.isnan(checked).all() and free.round(1).tolist() == [34, 500]
PYTHON
