"""Write and read the .ply of 3DGS, for the findings about splats: as little as they need, and nothing of nerfbake."""

from pathlib import Path

import numpy as np

NAMES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def write(path, *rows):
    """Write a .ply of 3DGS. rows: x, y, z and the logit of the opacity of each splat."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    head += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    table = np.array([[*row[:3], 0, 0, 0, 0.1, 0.2, 0.3, row[3], -3, -3, -3, 1, 0, 0, 0] for row in rows], "<f4")
    Path(path).write_bytes(head.encode() + table.tobytes())


def read(path):
    """Return the columns of a .ply by name."""
    head, _, body = Path(path).read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))
