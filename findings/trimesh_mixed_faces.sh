#!/usr/bin/env bash
# trimesh 5.2.0: a binary .ply with a quad and two triangles, as meshio 5.3.5 writes it.
#
# The format allows lists of different lengths. plyfile 1.1.5 and meshio read the file. trimesh refuses it, and blames
# the file:
#     ValueError: PLY is unexpected length!
# The same mesh in ASCII is read, as four triangles. A .ply that trimesh refuses can be valid: use another reader as the
# oracle of a writer. nerfbake's tests compare its .ply files with trimesh and with plyfile.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet --disable-pip-version-check \
    numpy==2.4.6 meshio==5.3.5 plyfile==1.1.5 trimesh==5.2.0

"$folder/env/bin/python" - <<'END'
import tempfile
from pathlib import Path

import meshio
import numpy as np
import plyfile
import trimesh

points = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [4, 0, 0]], float)
faces = [("quad", np.array([[0, 1, 2, 3]], np.int32)), ("triangle", np.array([[1, 4, 2], [0, 1, 2]], np.int32))]
found = {}
with tempfile.TemporaryDirectory() as folder:
    for binary in (True, False):
        path = Path(folder) / "mixed.ply"
        meshio.write(path, meshio.Mesh(points, faces), binary=binary)
        lengths = [len(row[0]) for row in plyfile.PlyData.read(str(path))["face"].data]
        assert lengths == [4, 3, 3]
        assert [len(block.data) for block in meshio.read(path).cells] == [1, 2]
        try:
            mesh = trimesh.load(path, process=False, force="mesh")
            found[binary] = f"{len(mesh.faces)} triangles"
        except ValueError as error:
            found[binary] = f"{type(error).__name__}: {error}"
        print("binary:" if binary else "ASCII:", "plyfile: faces of", lengths, " trimesh:", found[binary])
assert found == {True: "ValueError: PLY is unexpected length!", False: "4 triangles"}
END
