"""COLMAP's cameras.txt and images.txt; colmap.py tells what is in their lines."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import MAX_FRAMES
from nerfbake.formats.camera.colmap_models import MODELS, Model, Shot

_LINE = re.compile(rb"[^\n]*\n?")
_SIZES = dict(MODELS.values())
_MAX_LINE = 8192  # bytes of a line that is read; a line of points is passed over


def decode_models(view: memoryview, name: str) -> dict[int, Model]:
    """By their ids, which are no indices."""
    models = {}
    for number, line in _lines(view, name):
        own, model, width, height, *parameters = _parts(line, 5, number, name)
        if model not in _SIZES:
            raise InvalidFile(Problem(f"{name}: line {number:,}", f"has model {model[:40]}", ", ".join(_SIZES)))
        if len(parameters) != _SIZES[model]:
            found = f"has {len(parameters)} parameters"
            raise InvalidFile(Problem(f"{name}: line {number:,}", found, f"{_SIZES[model]} for {model}"))
        numbers = _numbers((own, width, height, *parameters), number, name)
        own_id, *edges = (_whole(value, number, name) for value in numbers[:3])
        models[own_id] = Model(model, edges[0], edges[1], numbers[3:])
    return models


def decode_shots(view: memoryview, name: str) -> list[Shot]:
    shots = []
    for number, line in _lines(view, name, skip=1):
        parts = _parts(line, 10, number, name)
        numbers = _numbers(parts[:9], number, name)
        model = _whole(numbers[8], number, name)
        shots.append(Shot(numbers[1:5], numbers[5:8], model, " ".join(parts[9:])))
    return shots


def _lines(view: memoryview, name: str, *, skip: int = 0) -> Iterator[tuple[int, str]]:
    """Numbers and texts of lines that are neither empty nor a comment; behind each, so many are passed over."""
    pass_over = found = 0
    for number, match in enumerate(_LINE.finditer(view), start=1):
        if pass_over:
            pass_over -= 1
            continue
        start, end = match.span()
        line = bytes(view[start : min(end, start + _MAX_LINE)]).strip()
        if not line or line.startswith(b"#"):
            continue
        found += 1
        if end - start > _MAX_LINE or found > MAX_FRAMES:
            what = f"has {end - start:,} bytes" if found <= MAX_FRAMES else f"is entry {found:,}"
            raise InvalidFile(Problem(f"{name}: line {number:,}", what, f"{_MAX_LINE:,} bytes, {MAX_FRAMES:,} entries"))
        yield number, line.decode(errors="replace")
        pass_over = skip


def _parts(line: str, least: int, number: int, name: str) -> list[str]:
    parts = line.split()
    if len(parts) < least:
        raise InvalidFile(Problem(f"{name}: line {number:,}", f"has {len(parts)} entries", f"{least} or more"))
    return parts


def _numbers(parts: tuple[str, ...] | list[str], number: int, name: str) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, parts))
    except ValueError:
        numbers = (math.nan,)
    if not all(map(math.isfinite, numbers)):
        raise InvalidFile(Problem(f"{name}: line {number:,}", "holds a value that is not a number", "finite numbers"))
    return numbers


def _whole(value: float, number: int, name: str) -> int:
    if value != int(value):
        raise InvalidFile(Problem(f"{name}: line {number:,}", f"has {value:g}", "a whole number there"))
    return int(value)
