"""wgpu: loaded on first use, without its messages, and with its errors as DeviceError."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from nerfbake.errors import DeviceError, one_line
from nerfbake.installation import is_installed

MODULE = "wgpu"
_LONGEST = 160  # characters of a driver's message
_process: list[int] = []  # the process that loaded wgpu


def is_available() -> bool:
    """Return whether wgpu is installed, without importing it."""
    return is_installed(MODULE)


def load() -> Any:
    """Return the module wgpu. Raises DeviceError if its library cannot be loaded.

    From then on wgpu's log is off, because its messages also arrive as exceptions. Threads of a driver do not survive
    fork(), so a forked process cannot use a library that its parent has loaded.
    """
    if _process and _process[0] != os.getpid():
        raise DeviceError("the graphics driver cannot be used in a process that was forked after it was loaded")
    if _process:  # this is called for every use of the device
        return sys.modules[MODULE]
    with _quiet_environment():
        try:
            import wgpu
        except (ImportError, OSError, RuntimeError) as error:
            raise DeviceError(f"wgpu cannot be loaded: {one_line(str(error), _LONGEST)}") from error
    _process[:] = [os.getpid()]
    logging.getLogger("wgpu").setLevel(logging.CRITICAL + 1)
    return wgpu


@contextmanager
def quiet(what: str) -> Iterator[None]:
    """Raise the errors of wgpu inside the block as DeviceError.

    what: begins the line, such as "llvmpipe: the shader"
    """
    wgpu = load()
    with _quiet_environment():
        try:
            yield
        except (wgpu.GPUError, RuntimeError, OSError, ValueError) as error:
            raise DeviceError(f"{what}: {_cause(str(error))}") from error


def _cause(text: str) -> str:
    """The cause in a message of wgpu, which names its own functions before it."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    while lines and (lines[0] in ("Validation Error", "Caused by:") or lines[0].startswith("In wgpu")):
        del lines[0]
    return one_line(" ".join(lines) or "an error without a message", _LONGEST)


@contextmanager
def _quiet_environment() -> Iterator[None]:
    """Set XDG_RUNTIME_DIR if it is not set: otherwise EGL prints an error for every adapter."""
    name = "XDG_RUNTIME_DIR"
    if name in os.environ:
        yield
        return
    os.environ[name] = tempfile.gettempdir()
    try:
        yield
    finally:
        os.environ.pop(name, None)
