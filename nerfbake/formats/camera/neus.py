"""Read cameras_sphere.npz and cameras.npz of NeuS, IDR and VolSDF.

world_mat_i    4 x 4, whose first three rows are P = K [R | t] up to sign, OpenCV's axes
scale_mat_i    takes the unit sphere, in which these programs train, to the world; it is not applied here
camera_mat_i   is not K, and is not read

The pictures are those in `image`, in the order of their names. The file has no sizes: they come from the pictures.
Source: 0.41 pixels on 693 matches of a real capture.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import MAX_VALUE, Album, Posed, cameras_of, require_count
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.turns import pose_at, taken_apart
from nerfbake.formats.wire.npz import NpzReader
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens

_KEY = "world_mat_"
_NOISE = 0.01  # pixels: a skew that is the rounding of P
_FOLDERS = ("image", "images", "rgb", "")


def recognise(name: str, head: bytes) -> bool:
    return head.startswith(b"PK") and any(f"{key}0.npy".encode() in head for key in (_KEY, "scale_mat_"))


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    matrices = list(_matrices(NpzReader(files[name]), name))
    require_count(len(matrices), name)
    album = Album(files, _FOLDERS)
    paths, notes = album.numbered(), tuple[str, ...]()
    if len(paths) != len(matrices):
        notes = (f"{plural(len(paths), 'picture')} for {len(matrices):,} cameras; the cameras are numbered",)
        paths = [""] * len(matrices)
    sizes, guesses = album.sizes(paths)
    posed = []
    for i, (P, path, size) in enumerate(zip(matrices, paths, sizes, strict=True)):
        K, R, C = taken_apart(P[:3], f"{name}: {_KEY}{i}")
        focal, centre = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
        skew = float(K[0, 1])
        lens = Lens("polynomial", skew=skew / focal[0]) if abs(skew) > _NOISE else None
        posed.append(Posed(path or f"{i:06d}", path, pose_at(R, C), size, focal, centre, lens))
    return cameras_of(posed, dialect="NeuS", source=name, notes=(*notes, *guesses))


def _matrices(archive: NpzReader, name: str) -> Iterator[Floats]:
    i = 0
    while f"{_KEY}{i}" in archive:
        matrix = cast(archive.shaped(f"{_KEY}{i}", "fiu", (None, 4)), np.float64)
        if len(matrix) not in (3, 4) or not (np.abs(matrix) <= MAX_VALUE).all():
            raise InvalidFile(Problem(f"{name}: {_KEY}{i}", "is not 4 x 4 finite numbers", "K [R | t]"))
        yield matrix
        i += 1
