"""Cameras as a package of USD (.usdz) with one crate; usd.py describes the prims."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from nerfbake.formats.camera.usd import camera_stage, decode, recognise
from nerfbake.formats.wire.usd.package import package_stage
from nerfbake.scene.camera import Cameras

__all__ = ["decode", "encode", "recognise"]


def encode(cameras: Cameras, *, up: Literal["z", "y"] = "z") -> Iterator[bytes | memoryview]:
    """Encode cameras. up: the axis of their world that points up. Raises InvalidScene for lens distortion."""
    return package_stage(camera_stage(cameras, up=up))
