"""Volumes as text of USD (.usda) beside a .vdb, written only; usd_stage.py describes the prims."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

from nerfbake.formats.volume import openvdb
from nerfbake.formats.volume.openvdb import DEFAULT_GRIDS, FIELD_GRIDS, HALF_NOTE, KEEPS_HALVES, require_grids
from nerfbake.formats.volume.usd_stage import VDB, refused, volume_stage
from nerfbake.formats.wire.usd.text import encode_text
from nerfbake.scene.volume import Volume

__all__ = ["DEFAULT_GRIDS", "FIELD_GRIDS", "HALF_NOTE", "KEEPS_HALVES", "encode", "encode_files", "require_grids"]


def encode(volume: Volume, *, codec: Literal["none", "zip"] = "zip", up: Literal["z", "y"] = "z") -> Iterator[bytes]:
    """Raise InvalidScene: encode_files() writes the stage and the .vdb."""
    raise refused()


def encode_files(
    volume: Volume, stem: str, *, codec: Literal["none", "zip"] = "zip", up: Literal["z", "y"] = "z"
) -> Iterator[tuple[str, Iterable[bytes | memoryview]]]:
    """Yield the extension and the bytes of the stage, then those of the .vdb.

    codec: of the .vdb; up: the axis that points up. Raises InvalidScene for an index grid.
    """
    yield ".usda", encode_text(volume_stage(volume, stem, up=up))
    yield VDB, openvdb.encode(volume, codec=codec)
