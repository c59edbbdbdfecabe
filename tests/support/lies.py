"""Changes that make a folder with a scene_params.json invalid. They edit its `fields` or the bytes of its files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake.cli.main import run
from tests.support.snerg import Files, png

Lie = Callable[[dict[str, Any], Files], None]
PARAMS = "scene_params.json"


def changed(**values: Any) -> Lie:
    """Replace values of scene_params.json. Leading underscores of the names are removed."""
    named = {key.lstrip("_"): value for key, value in values.items()}
    return lambda made, files: files.update({PARAMS: json.dumps(made["fields"] | named).encode()})


def no_field(key: str) -> Lie:
    return lambda made, files: files.update(
        {PARAMS: json.dumps({k: v for k, v in made["fields"].items() if k != key}).encode()}
    )


def without(name: str) -> Lie:
    def change(made: dict[str, Any], files: Files) -> None:
        del files[name]

    return change


def picture(name: str, *shape: int, value: int = 0) -> Lie:
    return lambda made, files: files.update({name: png(np.full(shape, value, np.uint8))})


def half_of(name: str) -> Lie:
    return lambda made, files: files.update({name: files[name][: len(files[name]) // 2]})


def assert_refused(folder: Path, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that `svo` reports this error for the folder in one line and writes nothing."""
    out = folder.parent / "out.svo.pb"
    assert run(["svo", str(folder), str(out), "-q"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}: ")
    assert expected in line
    assert not out.exists()
