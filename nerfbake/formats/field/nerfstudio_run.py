"""Read the folder of a nerfstudio run, `outputs/NAME/METHOD/TIME`: its last checkpoint, and the files beside it.

nerfstudio_models/step-000029999.ckpt     nerfstudio.py reads it; the highest number is taken
config.yml, dataparser_transforms.json    run_files.py reads them
"""

from __future__ import annotations

import re
from typing import Protocol

from nerfbake.errors import InvalidFile, Problem, within
from nerfbake.formats.field.nerfstudio import field_of
from nerfbake.formats.field.run_files import CONFIG, WORLD, RunFolder, read_run
from nerfbake.scene.function_field import FunctionField

_MODELS = "nerfstudio_models"
_STEP = re.compile(r"step-(\d{1,18})\.ckpt")
FILES = re.compile(r"(?!)")  # runs are only read


class ListedFolder(RunFolder, Protocol):
    """Files by name, and the names in a subfolder."""

    def names(self, folder: str) -> list[str]: ...


def recognise(files: ListedFolder) -> bool:
    """Return whether the folder has a checkpoint, or the files that lie beside them."""
    return bool(_steps(files)) or (CONFIG in files and WORLD in files)


def decode(files: ListedFolder) -> FunctionField:
    """Return the field of a run. Raises InvalidFile with the name of the file, MemoryLimit."""
    steps = _steps(files)
    if not steps:
        raise InvalidFile(Problem(_MODELS, "has no checkpoint", "step-NUMBER.ckpt"))
    name = f"{_MODELS}/{max(steps)[1]}"
    run = read_run(files)
    with within(name):
        return field_of(files[name], run)


def _steps(files: ListedFolder) -> list[tuple[int, str]]:
    found = [(match, name) for name in files.names(_MODELS) if (match := _STEP.fullmatch(name))]
    return [(int(match[1]), name) for match, name in found]
