"""numba's compiler, with the options that every kernel here uses and the types that it drops.

Compiled code is kept beside the module, or in the user's cache, so that only the first run ever pays for it; where
neither can be written, every run does. It lets go of the interpreter, for kernels.parallel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar, cast

import numba

uncached: list[str] = []  # kernels that are compiled anew in every process

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(*, parallel: bool = False, inline: bool = False) -> Callable[[Function], Function]:
    """Compiles a function.

    There is no fastmath: it lets the compiler reorder, fuse and estimate by what the CPU has, and the last bits of what
    comes out would tell one CPU from another. Where a sum is to be vectorised, the code says which terms go together.
    """

    def compile_(function: Function) -> Function:
        how: Literal["always", "never"] = "always" if inline else "never"
        options: Any = {"nogil": True, "parallel": parallel, "inline": how}
        try:
            result: Any = numba.njit(function, cache=True, **options)
        except RuntimeError:  # numba found no folder that it may write to
            uncached.append(function.__name__)
            result = numba.njit(function, **options)
        return cast(Function, result)

    return compile_
