#!/usr/bin/env bash
# trimesh 4.12.2 and 5.2.0: polygons that are read from a text .ply are refused in a binary one.
#
# The same quadrilateral and triangle are stored as text and as binary_little_endian. The text is read: 3 triangles.
# The binary file raises "PLY is unexpected length!": the reader takes the length of the first list for that of all. A
# .ply of polygons of one length is read in both forms, so programs that write quadrilaterals and triangles together
# (remeshers, CAD) appear to write broken files.
#
# Seen on 2026-11-27, both versions alike:
#   text: 3 triangles
#   binary: ValueError: PLY is unexpected length!
#
# nerfbake reads lists of any lengths, in both forms.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat >"$folder/run.py" <<'PYTHON'
import io
import struct

import trimesh

head = """ply
format {} 1.0
element vertex 5
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
"""
points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]
faces = [(0, 1, 2, 3), (3, 2, 4)]
text = head.format("ascii") + "".join("%g %g %g\n" % point for point in points)
text += "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces)
binary = head.format("binary_little_endian").encode() + b"".join(struct.pack("<3f", *point) for point in points)
binary += b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
found = len(trimesh.load(io.BytesIO(text.encode()), file_type="ply").faces)
print(f"text: {found} triangles")
assert found == 3
try:
    trimesh.load(io.BytesIO(binary), file_type="ply")
except ValueError as error:
    print(f"binary: ValueError: {error}")
else:
    raise SystemExit("the binary file is read")
PYTHON
python3 -m venv "$folder/venv"
for version in 4.12.2 5.2.0; do
    "$folder/venv/bin/pip" install -q --disable-pip-version-check "trimesh==$version" numpy==2.4.6
    echo "trimesh $version"
    "$folder/venv/bin/python" "$folder/run.py"
done
