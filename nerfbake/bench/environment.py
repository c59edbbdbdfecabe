"""Where figures come from: the machine and the versions, without which they say nothing."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from nerfbake.io.machine import machine


def environment(*packages: str) -> dict[str, str]:
    """Machine, Python and the versions of these packages, '-' for one that is not installed."""
    return {"machine": machine(), "Python": platform.python_version(), **{name: _version(name) for name in packages}}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "-"
