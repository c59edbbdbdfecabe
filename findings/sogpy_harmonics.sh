#!/usr/bin/env bash
# sogpy 1.0.2: the colour of a .sog changes its hue with the direction, because red, green and blue have changed places.
#
# A .ply of 3DGS has all coefficients of red, then of green, then of blue. A pixel of a .sog's palette has the red, green
# and blue of one coefficient. sogpy, a package of 2026, fills the pixels in the order of the .ply: three coefficients of
# red become the red, green and blue of one. Readers find the file valid, and colours of degree 0 are right. A scene of
# fewer than 1,024 splats with harmonics raises a ValueError instead, because its palette has more rows than the scene.
#
# Seen on 2026-11-28 (coefficients of the .ply that are not 0; those that gaussforge 0.6.0 reads from the .sog):
#   red of y, z, x ['f_rest_0', 'f_rest_1', 'f_rest_2']: ['f_rest_0', 'f_rest_3', 'f_rest_6']
#   green of y ['f_rest_3']: ['f_rest_1']
#   300 splats: cannot reshape array of size 2700 into shape (1024,9)
#
# nerfbake writes and reads the pixels as splat-transform does. It cannot tell such a file from a right one.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check sogpy==1.0.2 gaussforge==0.6.0 numpy==2.4.6
venv/bin/python - <<'PYTHON' 2>log || { cat log; exit 1; }
import subprocess

import gaussforge
import numpy as np

REST = [f"f_rest_{k}" for k in range(9)]
NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *REST, "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3"]


def write(n, *filled):
    rng = np.random.default_rng(1)
    columns = {name: rng.normal(size=n) if name in "xyz" else np.full(n, 0.1) for name in NAMES}
    for name in REST:
        columns[name] = rng.uniform(0.2, 0.8, n) if name in filled else np.zeros(n)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    head += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    open("in.ply", "wb").write(head.encode() + np.stack(list(columns.values()), axis=1).astype("<f4").tobytes())


def convert():
    run = subprocess.run(["venv/bin/sogpy", "in.ply", "out.sog"], capture_output=True, text=True)
    return run.stdout + run.stderr


for words, filled, expected in (
    ("red of y, z, x", REST[:3], REST[::3]),
    ("green of y", REST[3:4], REST[1:2]),
):
    write(3000, *filled)
    convert()
    data = gaussforge.GaussForge().convert(open("out.sog", "rb").read(), "sog", "ply")["data"]
    head, _, body = data.partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    table = dict(zip(names, np.frombuffer(body, "<f4").reshape(3000, -1).T, strict=True))
    found = [name for name in REST if abs(table[name]).mean() > 0.1]
    print(f"{words} {filled}: {found}")
    assert found == expected
write(300, *REST)
(told,) = (line for line in convert().splitlines() if line.startswith("Error: "))
print(f"300 splats: {told.removeprefix('Error: ')}")
assert "cannot reshape array" in told
PYTHON
