"""Read videos, and write photographs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nerfbake import memory
from nerfbake.catalog import load_photographs, load_videos
from nerfbake.errors import OutputError
from nerfbake.io.sources import blame


@contextmanager
def opened_video(path: str | Path) -> Iterator[Any]:
    """Open a video. Its frames are decoded while it is iterated over, inside the block; see formats.wire.video.

    Raises InvalidFile, MemoryLimit, and UsageError if the library for it is missing.
    """
    with blame(str(path)), memory.scope(), Path(path).open("rb") as file, load_videos().opened_video(file) as video:
        yield video


def save_photograph(path: str | Path, pixels: Any) -> None:
    """Write (H, W, 3) uint8, sRGB, as a JPEG. Raises OutputError."""
    with blame(str(path), OutputError):
        Path(path).write_bytes(load_photographs().encode_photograph(pixels))
