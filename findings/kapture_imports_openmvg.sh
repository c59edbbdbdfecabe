#!/usr/bin/env bash
# kapture 1.1.12: a camera that is imported from openMVG is half a pixel off, and loses its third coefficient.
#
# kapture's manual counts pixels from the upper left corner ("[0, 0] is the upper left corner") and has COLMAP's camera
# models; for openMVG, (0, 0) is the centre of the first pixel. The principal point is copied. A pinhole_radial_k3
# becomes a RADIAL, which has k1 and k2: k3 is dropped without a word.
#
# Seen on 2026-11-28, of a pinhole_radial_k3 with the principal point 400.5 299.5 and k1 k2 k3 of -0.1 0.02 0.005:
#   RADIAL 800 600 500 400.5 299.5 -0.1 0.02
#
# nerfbake reads openMVG's file with half a pixel more and all coefficients; what kapture imports from a COLMAP model is
# read to the same numbers as that model.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check kapture==1.1.12
cat >sfm_data.json <<'JSON'
{"sfm_data_version": "0.3", "root_path": ".", "structure": [], "control_points": [],
 "views": [{"key": 0, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483649, "data": {
   "local_path": "", "filename": "a.jpg", "width": 800, "height": 600, "id_view": 0, "id_intrinsic": 0, "id_pose": 0}}}}],
 "intrinsics": [{"key": 0, "value": {"polymorphic_id": 2147483649, "polymorphic_name": "pinhole_radial_k3",
   "ptr_wrapper": {"id": 2147483650, "data": {"width": 800, "height": 600, "focal_length": 500.0,
   "principal_point": [400.5, 299.5], "disto_k3": [-0.1, 0.02, 0.005]}}}}],
 "extrinsics": [{"key": 0, "value": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "center": [0, 0, 0]}}]}
JSON
venv/bin/kapture_import_openmvg -s sfm_data.json -o out -y --image_action skip >log 2>&1
found=$(grep -v '^#' out/sensors/sensors.txt | cut -d, -f4- | tr -d ' ' | tr ',' ' ')
echo "$found"
test "$found" = "RADIAL 800 600 500 400.5 299.5 -0.1 0.02"
