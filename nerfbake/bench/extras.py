"""Libraries that a plain installation leaves out, and the extra of nerfbake that brings each."""

from __future__ import annotations

from importlib.util import find_spec

from nerfbake.errors import Problem, UsageError

EXTRAS = {
    "matplotlib": "plot",
    "warp": "warp",
    "playwright": "browser",
}  # the module's name: the extra's, as pyproject.toml has it


def command_for(module: str) -> str:
    """What installs a module's library beside this nerfbake; '' where no extra brings it."""
    return f"pip install 'nerfbake[{EXTRAS[module]}]'" if module in EXTRAS else ""


def require_installed(module: str, what: str) -> None:
    """Raises UsageError where what is asked for needs a module that is not installed."""
    if find_spec(module) is None:
        raise UsageError(Problem(what, f"needs {module}, which is not installed", command_for(module)))
