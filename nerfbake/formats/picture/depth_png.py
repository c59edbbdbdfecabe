"""Read and write depth as a 16-bit grey PNG: thousandths of a world unit, 0 where a ray hits nothing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from PIL import Image

from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.wire.picture import opened, png_of
from nerfbake.scene.image import Depth

STEPS = 1000  # grey levels for each world unit
_MOST = 65535


def recognise(view: memoryview) -> bool:
    """True for a PNG with 16 bits of grey."""
    return bytes(view[:8]) == b"\x89PNG\r\n\x1a\n" and bytes(view[24:26]) == b"\x10\x00"


def encode(depth: Depth) -> Iterator[bytes]:
    """Raises InvalidScene for distances beyond 65.535."""
    steps = np.rint(depth.distance.astype(np.float64) * STEPS)
    if steps.max(initial=0) > _MOST:
        found = f"reaches {depth.distance.max():g} world units"
        raise InvalidScene(Problem("depth", found, f"up to {_MOST / STEPS:g} in a .png; .npy has no limit"))
    # A hit is never 0, however near.
    yield png_of(Image.fromarray(np.where(depth.distance > 0, np.maximum(steps, 1), 0).astype(np.uint16)))


def decode(view: memoryview) -> Depth:
    with opened(view, "PNG", "PNG", bytes_per_pixel=11) as picture:
        if not picture.mode.startswith("I"):
            raise InvalidFile(Problem("PNG", f"holds {picture.mode} pixels", "16 bits of grey"))
        steps = np.asarray(picture)
    distance = np.empty(steps.shape, np.float32)
    np.divide(steps, float(STEPS), out=distance, casting="same_kind")  # in float64, then rounded once
    return Depth(distance)
