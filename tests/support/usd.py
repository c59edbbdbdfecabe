"""Stages in OpenUSD, which judges ours, and small layers as text."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdValidation

from nerfbake import memory
from nerfbake.formats.wire.usd import _child, reading
from nerfbake.formats.wire.usd.package import encode_package
from tests.conftest import REPOSITORY

HEAD = '#usda 1.0\n(\n defaultPrim = "scene"\n metersPerUnit = {metres}\n upAxis = "{up}"\n)\n'


def layer(body: str, *, up: str = "Y", metres: float = 1.0) -> bytes:
    """A layer with these prims in an Xform."""
    head = HEAD.format(up=up, metres=metres)
    return f'{head}def Xform "scene"\n{{\n{body}\n}}\n'.encode()


def opened(path: Path, data: bytes) -> Any:
    """A stage of these bytes, which are written to the path."""
    path.write_bytes(data)
    return Usd.Stage.Open(str(path))


def exported(path: Path, data: bytes) -> str:
    """The text that OpenUSD writes of a layer with these bytes."""
    path.write_bytes(data)
    return str(Sdf.Layer.FindOrOpen(str(path)).ExportToString())


def errors_of(stage: Any) -> list[str]:
    """What the validators of OpenUSD find in a stage."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{each.GetName()}: {each.GetMessage()}" for each in found]


def facts_of(stage: Any) -> tuple[str, float, str]:
    """Up axis, metres per unit, and the path of the default prim."""
    assert stage.HasAuthoredMetadata("upAxis")
    assert stage.HasAuthoredMetadata("metersPerUnit")
    path = str(stage.GetDefaultPrim().GetPath())
    return str(UsdGeom.GetStageUpAxis(stage)), UsdGeom.GetStageMetersPerUnit(stage), path


def package(files: Mapping[str, bytes]) -> bytes:
    """A .usdz of these files."""
    return b"".join(encode_package([(name, [data]) for name, data in files.items()]))


def _run(layers: Mapping[str, memoryview]) -> tuple[dict[str, Any], memoryview]:
    """What the child answers, from this process, which has loaded OpenUSD already."""
    arrays = _child.Arrays()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, data in layers.items():
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_bytes(data)
        try:
            answer = _child.read_stage(next(iter(layers)), list(layers), arrays)
        except _child.Refused as refused:
            answer = {"error": refused.args}
        return json.loads(json.dumps(answer)), memoryview(b"".join(arrays.views))


@contextlib.contextmanager
def read_here() -> Iterator[None]:
    """Read stages without a process of their own, which takes a quarter of a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading, "run_child", _run)
        yield


@pytest.fixture
def in_this_process() -> Iterator[None]:
    """read_here() for a test."""
    with read_here():
        yield


class UsdServer:
    """A process that has loaded OpenUSD, and reads each stage in a fork. One request takes a hundredth of a second."""

    def __init__(self) -> None:
        environment = os.environ | {"PXR_WORK_THREAD_LIMIT": "1"}
        command = [sys.executable, "-m", "tests.support.usd_server"]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            cwd=REPOSITORY,
        )

    def exchange(self, pieces: Sequence[bytes | memoryview]) -> tuple[memoryview, int]:
        """What the child of reading.exchange() would answer, and its exit code."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(b"".join(pieces))
        self._process.stdin.flush()
        code, size = json.loads(self._process.stdout.readline())
        memory.hold("the stage", size)
        return memoryview(self._process.stdout.read(size)), code

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture(scope="module")
def in_forks() -> Iterator[None]:
    """Read all stages of a module in forks of one process, where they may crash."""
    server = UsdServer()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading, "exchange", server.exchange)
        yield
    server.close()
