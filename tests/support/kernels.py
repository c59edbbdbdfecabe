"""Which kernels of nerfbake have run in this process."""

from __future__ import annotations

import gc
import sys


def kernels_that_ran() -> list[str]:
    """The names of the compiled kernels that were called with arguments; none where kernels are plain Python."""
    if "numba" not in sys.modules:
        return []
    from numba.core.registry import CPUDispatcher

    kernels = [each for each in gc.get_objects() if type(each) is CPUDispatcher and each.signatures]
    names = [f"{each.py_func.__module__}.{each.py_func.__name__}" for each in kernels]
    return sorted(name for name in names if name.startswith("nerfbake."))
