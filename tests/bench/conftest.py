"""What tests of benchmarks share."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import pytest

from nerfbake.bench.measure import Result, Work, measure_here

MODULES = ("access.comparison", "atlas", "compress", "formats.comparison", "measure")


def quiet(_: str) -> AbstractContextManager[None]:
    """Progress that nobody sees."""
    return nullcontext()


def here(function: Callable[..., Work], **arguments: Any) -> Result:
    """What measure() does, without a child process: a second less for each row."""
    return measure_here(function.__module__, function.__name__, json.loads(json.dumps(arguments)))


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work is measured here instead of in a child. test_measure.py tests the children."""
    for module in MODULES:
        monkeypatch.setattr(f"nerfbake.bench.{module}.measure", here)
