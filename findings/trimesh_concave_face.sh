#!/usr/bin/env bash
# trimesh 5.2.0: an .obj with one plane face of five corners, one of which is a notch.
#
# The square of 2 x 2 with a notch to (1, 0.5) has an area of 2.5. trimesh makes a fan from the first corner, whose
# triangles fold over each other, without a warning:
#     [[0, 1, 2], [0, 2, 3], [0, 3, 4]], area 3.5
# If the file begins with the corner of the notch, the area is right. So areas, centres and samples of a mesh can depend
# on which corner a modeller writes first. A mesh of triangles, as nerfbake writes it, is safe.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet --disable-pip-version-check numpy==2.4.6 trimesh==5.2.0

"$folder/env/bin/python" - <<'END'
import io

import trimesh

corners = ["0 0 0", "2 0 0", "2 2 0", "1 0.5 0", "0 2 0"]
areas = {}
for first in (0, 3):
    turned = corners[first:] + corners[:first]
    text = "".join(f"v {corner}\n" for corner in turned) + "f 1 2 3 4 5\n"
    mesh = trimesh.load(io.BytesIO(text.encode()), file_type="obj", process=False, force="mesh")
    areas[turned[0]] = float(mesh.area)
    print(f"first corner {turned[0]}: faces {mesh.faces.tolist()}, area {mesh.area:g}; it is 2.5")
assert areas == {"0 0 0": 3.5, "1 0.5 0": 2.5}
END
