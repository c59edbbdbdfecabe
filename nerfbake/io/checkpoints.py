"""Checkpoints: the state of a computation in a folder. Each checkpoint replaces the previous one atomically."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from nerfbake import memory
from nerfbake.catalog import load_checkpoints
from nerfbake.errors import OutputError
from nerfbake.io.sources import blame, read_file
from nerfbake.io.targets import replacing

_NAME = "checkpoint.npz"


def checkpoint_path(folder: str | Path) -> Path:
    """The path of this folder's checkpoint, whether it exists or not."""
    return Path(folder) / _NAME


def require_checkpoints(folder: str | Path) -> None:
    """Create the folder, or raise OutputError. Call this before the work."""
    with blame(str(folder), OutputError):
        Path(folder).mkdir(parents=True, exist_ok=True)


def save_checkpoint(folder: str | Path, facts: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Write the checkpoint. Raises OutputError; the previous checkpoint is then kept."""
    path = checkpoint_path(folder)
    with blame(str(path), OutputError), replacing(path, force=True) as file:
        for piece in load_checkpoints().encode_checkpoint(facts, arrays):
            file.write(piece)


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoint, and the folder if nothing else is in it."""
    with suppress(OSError):
        checkpoint_path(folder).unlink(missing_ok=True)
        Path(folder).rmdir()


def load_checkpoint(folder: str | Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Return facts and arrays of the last checkpoint, unchecked; None if there is none yet.

    Raises InvalidFile, MemoryLimit.
    """
    path = checkpoint_path(folder)
    with blame(str(path)):
        if not path.exists():
            return None
        with memory.scope():
            return load_checkpoints().decode_checkpoint(read_file(path))
