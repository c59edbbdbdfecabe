"""Gaussian splats as a package of USD (.usdz) with one crate; usd.py describes the prims."""

from __future__ import annotations

from collections.abc import Iterator

from nerfbake.formats.splat.usd import (
    KEEPS_ORIGIN,
    KEEPS_UP,
    MOST_DEGREE,
    decode,
    recognise,
    splat_stage,
    stored_splats,
)
from nerfbake.formats.wire.usd.crate import encode_crate
from nerfbake.formats.wire.usd.package import encode_package
from nerfbake.scene.splats import Splats

__all__ = ["KEEPS_ORIGIN", "KEEPS_UP", "MOST_DEGREE", "decode", "encode", "recognise", "stored"]
stored = stored_splats


def encode(scene: Splats, *, half: bool = False) -> Iterator[bytes | memoryview]:
    """Encode splats. half: all but positions in half floats. Raises InvalidScene."""
    return encode_package([("scene.usdc", list(encode_crate(splat_stage(scene, half=half))))])
