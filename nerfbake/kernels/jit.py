"""numba's compiler, with the options that every kernel here uses and the types that it drops.

Compiled code is kept beside the module (or in the user's cache), so that only the first run ever pays for it. It lets
go of the interpreter, for kernels.parallel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(*, parallel: bool = False, fastmath: bool = False, inline: bool = False) -> Callable[[Function], Function]:
    """Compiles a function. fastmath lets sums be reordered, hence vectorised: their inputs must be finite."""

    def compile_(function: Function) -> Function:
        how: Literal["always", "never"] = "always" if inline else "never"
        result: Any = numba.njit(function, cache=True, nogil=True, parallel=parallel, fastmath=fastmath, inline=how)
        return cast(Function, result)

    return compile_
