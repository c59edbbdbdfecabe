"""The machine and the versions that a report's figures depend on."""

from __future__ import annotations

import platform

from nerfbake.io.machine import machine


def environment(*packages: str) -> dict[str, str]:
    """Return the machine, the Python version and the versions of these packages; '-' if not installed."""
    return {"machine": machine(), "Python": platform.python_version(), **{name: _version(name) for name in packages}}


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version  # slow to import; the help does not need it

    try:
        return version(name)
    except PackageNotFoundError:
        return "-"
