"""The machine, the versions and the optional libraries that a report's figures depend on."""

from __future__ import annotations

import platform
from importlib.util import find_spec

from nerfbake.errors import Problem, UsageError
from nerfbake.io.machine import machine

# Module: the extra of pyproject.toml that installs it, in the order of the extra `test`.
EXTRAS = {"matplotlib": "plot", "warp": "warp", "pycolmap": "poses", "pillow_heif": "heic"}


def environment(*packages: str) -> dict[str, str]:
    """Return the machine, the Python version and the versions of these packages; '-' if not installed."""
    return {"machine": machine(), "Python": platform.python_version(), **{name: _version(name) for name in packages}}


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version  # slow to import; the help does not need it

    try:
        return version(name)
    except PackageNotFoundError:
        return "-"


def command_for(module: str) -> str:
    """Return the command that installs a module's library with nerfbake; '' if no extra contains it."""
    return f"pip install 'nerfbake[{EXTRAS[module]}]'" if module in EXTRAS else ""


def require_installed(module: str, what: str) -> None:
    """Raise UsageError if a module that `what` needs is not installed."""
    if find_spec(module) is None:
        raise UsageError(Problem(what, f"needs {module}, which is not installed", command_for(module)))
