"""Facts about this machine."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from nerfbake.errors import format_size


def cores() -> int:
    """The number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> str:
    """Processor, cores, memory and operating system, as one line."""
    return f"{_processor()}, {cores()} cores, {_memory()}, {platform.system()} {platform.machine()}"


def _memory() -> str:
    if not hasattr(os, "sysconf"):  # Windows
        return "unknown memory"
    return format_size(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "unknown processor"
