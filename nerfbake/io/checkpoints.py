"""Where a piece of work stands, kept in a folder: a checkpoint is replaced by the next one in one step."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerfbake import memory
from nerfbake.catalog import load_checkpoints
from nerfbake.errors import OutputError
from nerfbake.io.sources import blame, read_file
from nerfbake.io.targets import replacing

_NAME = "checkpoint.npz"


def checkpoint_path(folder: str | Path) -> Path:
    """Where the checkpoint of this folder stands, or would stand."""
    return Path(folder) / _NAME


def require_checkpoints(folder: str | Path) -> None:
    """Makes the folder, and raises OutputError where there can be none: asked before the work, not after it."""
    with blame(str(folder), OutputError):
        Path(folder).mkdir(parents=True, exist_ok=True)


def save_checkpoint(folder: str | Path, facts: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Raises OutputError; the last checkpoint is then still there."""
    path = checkpoint_path(folder)
    with blame(str(path), OutputError), replacing(path, force=True) as file:
        for piece in load_checkpoints().encode_checkpoint(facts, arrays):
            file.write(piece)


def load_checkpoint(folder: str | Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Facts and arrays of the last checkpoint, as somebody wrote them; None where there is none yet.

    Raises InvalidFile, MemoryLimit.
    """
    path = checkpoint_path(folder)
    with blame(str(path)):
        if not path.exists():
            return None
        with memory.scope():
            return load_checkpoints().decode_checkpoint(read_file(path))
