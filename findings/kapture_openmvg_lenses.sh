#!/usr/bin/env bash
# kapture 1.1.12: a camera that is exported to openMVG loses its second focal length, its lens, or half a pixel.
#
# PINHOLE and OPENCV have a focal length for each axis; openMVG's cameras have one, so the mean is written, and no word
# says that the edge of this picture is off by 20 pixels. The k1 to k4 of OPENCV_FISHEYE become zeros, with a warning
# that the model is not compatible; openMVG's fisheye is the same polynomial, and has fields for all four. The principal
# point is copied, although (0, 0) is the corner of the first pixel for COLMAP's models, which kapture's are, and its
# centre for openMVG.
#
# Seen on 2026-11-28, of a PINHOLE 800 600 500 550 400 300 and an OPENCV_FISHEYE with k1 to k4 of 0.1 0.02 0.003 0.0004
# (openMVG's model, focal length, principal point, lens):
#   pinhole 525.0 [400.0, 300.0] None
#   fisheye 500.0 [400.0, 300.0] [0.0, 0.0, 0.0, 0.0]
#   warning: OpenCV fisheye model is not compatible with OpenMVG. Forcing distortion to 0
#
# nerfbake reads kapture's own files, with all of a lens, and openMVG's with half a pixel more.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check kapture==1.1.12
mkdir -p in/sensors
cat >in/sensors/sensors.txt <<'TEXT'
# kapture format: 1.1
# sensor_id, name, sensor_type, [sensor_params]+
plain, , camera, PINHOLE, 800, 600, 500, 550, 400, 300
fish, , camera, OPENCV_FISHEYE, 800, 600, 500, 500, 400, 300, 0.1, 0.02, 0.003, 0.0004
TEXT
cat >in/sensors/records_camera.txt <<'TEXT'
# kapture format: 1.1
# timestamp, device_id, image_path
0, plain, plain.jpg
1, fish, fish.jpg
TEXT
cat >in/sensors/trajectories.txt <<'TEXT'
# kapture format: 1.1
# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz
0, plain, 1, 0, 0, 0, 0, 0, 0
1, fish, 1, 0, 0, 0, 0, 0, 0
TEXT
mkdir in/sensors/records_data
venv/bin/python -c '
from PIL import Image
for name in ("plain", "fish"):
    Image.new("RGB", (800, 600)).save(f"in/sensors/records_data/{name}.jpg")'
venv/bin/kapture_export_openmvg -i in -o out -f >log 2>&1
venv/bin/python - <<'PYTHON'
import json
from pathlib import Path

text = Path("log").read_text()
file = next(path for path in Path("out").rglob("*.json") if "intrinsics" in path.read_text())
names, found = {}, []
for row in json.loads(file.read_text())["intrinsics"]:
    value = row["value"]
    data = value["ptr_wrapper"]["data"]
    lens = next((data[key] for key in ("fisheye", "disto_t2") if key in data), None)
    data = data.get("value0", data)
    found.append((value["polymorphic_name"], data["focal_length"], data["principal_point"], lens))
    print(*found[-1])
warnings = [line.split("OpenCV")[1] for line in text.splitlines() if "Forcing distortion" in line]
print("warning: OpenCV" + warnings[0])
assert found == [("pinhole", 525, [400, 300], None), ("fisheye", 500, [400, 300], [0, 0, 0, 0])] and len(warnings) == 1
PYTHON
