"""Read the tables of RealityCapture and RealityScan: a line for each picture, with columns that their header names.

#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2     "Internal/External camera parameters"
#name,x,y,z,omega,phi,kappa                                    without intrinsics: refused, unless f is there, too

A first line may count the cameras (#cameras 706). Angles are in degrees. Camera to world with OpenGL's axes is
Rz(-heading) Rx(pitch) Ry(roll): heading turns clockwise, and pitch 0 looks straight down. From omega, phi and kappa it
is Ry(kappa) Rx(phi) Rz(-omega), which is not the photogrammetric Rx Ry Rz.
Source: pairs of such a line and an .xmp of one project agree to 1e-13.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, cameras_of, finite, turn_limited
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder
from nerfbake.formats.camera.realitycapture import DIALECT, Sidecar, unchecked_note
from nerfbake.formats.camera.turns import joined, turn_about
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Cameras

_HEADING, _OMEGA = ("heading", "pitch", "roll"), ("omega", "phi", "kappa")
_COUNTS = b"#cameras"
_MAX_LINE = 4096  # bytes
_KNOWN = {"name", "x", "y", "z", "alt", *_HEADING, *_OMEGA, "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2"}


def recognise(name: str, head: bytes) -> bool:
    for line in head.splitlines()[:2]:
        columns = _columns(line)
        if columns[:3] == ["name", "x", "y"] and any(set(angles) <= set(columns) for angles in (_HEADING, _OMEGA)):
            return True
    return False


def _columns(line: bytes) -> list[str]:
    text = line[:_MAX_LINE].decode("utf-8-sig", errors="replace").lstrip("#")
    return [part.strip().lower() for part in text.split(",")]


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    rows = _rows(bytes(files[name]), name)
    if not rows:
        raise InvalidFile(Problem(name, "has no pictures", "a line for each picture"))
    if "f" not in rows[0][1]:
        allowed = "a table with f, as `Internal/External camera parameters`, or the .xmp files"
        raise InvalidFile(Problem(name, "has no focal lengths", allowed))
    album = Album(files)
    shots = [_shot(place, row, album) for place, row in rows]
    sizes, notes = album.sizes([shot.picture for shot in shots])
    posed = [shot.posed(size) for shot, size in zip(shots, sizes, strict=True)]
    return cameras_of(posed, dialect=DIALECT, source=name, notes=(*notes, *unchecked_note(shots)))


def _rows(data: bytes, name: str) -> list[tuple[str, Mapping[str, str]]]:
    """Return the place and the columns by name of each line after the header."""
    lines = data.splitlines()
    start = 1 if lines and lines[0].startswith(_COUNTS) else 0
    columns = _columns(lines[start]) if start < len(lines) else []
    if len(set(columns)) != len(columns):
        raise InvalidFile(Problem(f"{name}: the header", "has a column twice", "each once"))
    if len(lines) - start - 1 > MAX_FRAMES:
        raise InvalidFile(Problem(name, f"has {len(lines):,} lines", f"up to {MAX_FRAMES:,}"))
    rows: list[tuple[str, Mapping[str, str]]] = []
    for number, line in enumerate(lines[start + 1 :], start=start + 2):
        place = f"{name}: line {number:,}"
        if not line.strip():
            continue
        if len(line) > _MAX_LINE:
            raise InvalidFile(Problem(place, f"has {len(line):,} bytes", f"up to {_MAX_LINE:,}"))
        parts = next(csv.reader([line.decode(errors="replace")]))
        if len(parts) != len(columns):
            raise InvalidFile(Problem(place, f"has {len(parts)} columns", f"{len(columns)}, as in the header"))
        rows.append((place, {key: part.strip() for key, part in zip(columns, parts, strict=True) if key in _KNOWN}))
    return rows


def _shot(place: str, row: Mapping[str, str], album: Album) -> Sidecar:
    height = "alt" if "alt" in row else "z"
    angles = _HEADING if set(_HEADING) <= set(row) else _OMEGA
    if missing := [key for key in ("name", "x", "y", height, *angles, "f") if key not in row]:
        raise InvalidFile(Problem(place, f"has no {missing[0]}", "a column for it"))
    numbers = [key for key in row if key != "name"]
    value = dict.fromkeys(("px", "py", "k1", "k2", "k3", "k4", "t1", "t2"), 0.0)
    value |= dict(zip(numbers, finite([row[key] for key in numbers], place), strict=True))
    a, b, c = turn_limited([value[key] for key in angles], place)
    pose = np.eye(4)
    pose[:3, :3] = turn_of_heading(a, b, c) if angles is _HEADING else turn_of_omega(a, b, c)
    pose[:3, 3] = [value["x"], value["y"], value[height]]
    k, centre = [value[key] for key in ("k1", "k2", "k3", "k4")], (value["px"], value["py"])
    label = row["name"]
    return Sidecar(label, album.find(label), pose, value["f"], centre, k, (value["t1"], value["t2"]), place)


def turn_of_heading(heading: float, pitch: float, roll: float) -> Floats:
    """Camera to world (3, 3), OpenGL's axes, from degrees."""
    return joined(turn_about(2, -heading), turn_about(0, pitch), turn_about(1, roll))


def turn_of_omega(omega: float, phi: float, kappa: float) -> Floats:
    """Camera to world (3, 3), OpenGL's axes, from degrees."""
    return joined(turn_about(1, kappa), turn_about(0, phi), turn_about(2, -omega))
