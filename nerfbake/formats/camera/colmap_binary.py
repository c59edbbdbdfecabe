"""COLMAP's cameras.bin and images.bin; colmap.py draws their bytes."""

from __future__ import annotations

import struct
from typing import Any

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import MAX_FRAMES
from nerfbake.formats.camera.colmap_models import MODELS, Model, Shot

_COUNT = struct.Struct("<Q")
_MODEL = struct.Struct("<IiQQ")
_SHOT = struct.Struct("<I7dI")
_POINT = 24  # bytes
_MAX_NAME = 4096


def decode_models(view: memoryview, name: str) -> dict[int, Model]:
    """By their ids, which are no indices."""
    count, at = _count(view, name)
    models = {}
    for _ in range(count):
        (own, number, width, height), at = _take(view, at, _MODEL, name)
        if number not in MODELS:
            raise InvalidFile(Problem(f"{name}: camera {own}", f"has model {number}", f"0 to {max(MODELS)}"))
        model, size = MODELS[number]
        parameters, at = _take(view, at, struct.Struct(f"<{size}d"), name)
        models[own] = Model(model, width, height, parameters)
    return models


def decode_shots(view: memoryview, name: str) -> list[Shot]:
    count, at = _count(view, name)
    shots = []
    for _ in range(count):
        (_, *pose, model), at = _take(view, at, _SHOT, name)
        end = bytes(view[at : at + _MAX_NAME]).find(0)
        if end < 0:
            raise InvalidFile(
                Problem(name, f"has a name without an end at byte {at:,}", f"{_MAX_NAME:,} bytes and NUL")
            )
        picture = bytes(view[at : at + end]).decode(errors="replace")
        (points,), at = _take(view, at + end + 1, _COUNT, name)
        at += _POINT * points
        shots.append(Shot(tuple(pose[:4]), tuple(pose[4:]), model, picture))
    if at > len(view):
        raise InvalidFile(Problem(name, f"ends after {len(view):,} bytes", f"{at:,} or more, as its counts say"))
    return shots


def _count(view: memoryview, name: str) -> tuple[int, int]:
    (count,), at = _take(view, 0, _COUNT, name)
    if count > MAX_FRAMES:
        raise InvalidFile(Problem(name, f"counts {count:,}", f"up to {MAX_FRAMES:,}"))
    return count, at


def _take(view: memoryview, at: int, what: struct.Struct, name: str) -> tuple[tuple[Any, ...], int]:
    if at + what.size > len(view):
        found = f"ends after {len(view):,} bytes"
        raise InvalidFile(Problem(name, found, f"{at + what.size:,} or more, as its counts say"))
    return what.unpack_from(view, at), at + what.size
