"""The numba compiler with the options that all kernels share.

compiled() keeps the type of the function, which numba's decorator drops.

Compiled code is cached beside the module or in the user's cache folder, so only the first run compiles. If neither is
writable, or the disk is full, every run compiles. Compiled kernels release the GIL, for kernels.parallel.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any, Literal, TypeVar, cast

import numba
from numba.core import event, types
from numba.extending import intrinsic

from nerfbake.kernels import compile_times
from nerfbake.kernels.kernel_cache import harden_cache


class _Listener(event.Listener):
    """Tells compile_times when numba compiles."""

    def on_start(self, event: object) -> None:
        compile_times.stopwatch.start()

    def on_end(self, event: object) -> None:
        compile_times.stopwatch.stop()


event.register("numba:compile", _Listener())  # type: ignore[no-untyped-call]

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(*, inline: bool = False, merged: bool = False) -> Callable[[Function], Function]:
    """Compile a function.

    inline and merged copy the function into its callers: inline before type inference, merged when machine code is
    generated. A merged function costs nothing for arrays in tuples if it names them where it uses them
    (`coder.data[i]`). Arrays that are unpacked first, and rows of arrays, have their references counted, which takes
    longer than the work on them.

    A division by zero returns what IEEE 754 defines: a check before each division would prevent vectorisation.

    Kernels copy arrays in loops. To assign one to a slice compiles numba's message about other shapes, which takes
    several seconds in each process.

    fastmath is off: it lets the compiler reorder, fuse and approximate operations depending on the CPU, so the last
    bits of the results would differ between CPUs. Where a sum is to be vectorised, the code states which terms are
    added together.
    """

    def compile_(function: Function) -> Function:
        how: Literal["always", "never"] = "always" if inline else "never"
        options: Any = {"nogil": True, "inline": how, "forceinline": merged, "no_cfunc_wrapper": True}
        options["error_model"] = "numpy"
        try:
            result: Any = numba.njit(function, cache=True, **options)
            if not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
                harden_cache(result._cache, lambda: compile_times.uncached.append(function.__name__))
        except RuntimeError:  # numba found no writable cache folder
            compile_times.uncached.append(function.__name__)
            result = numba.njit(function, **options)
        return cast(Function, result)

    return compile_


@compiled(merged=True)
def part_of(count: int, part: int, parts: int) -> tuple[int, int]:
    """Return the begin and the end of a part of 0 .. count. The parts are equal, and in order."""
    return count * part // parts, count * (part + 1) // parts


def _borrowed(typing: Any, held: Any) -> Any:
    """borrowed(held): the same array, or the same tuple of arrays and numbers, without counting references.

    Otherwise every call with an array counts a reference, and threads wait for each other at every count. A kernel may
    borrow its arguments, because its caller keeps them.
    """

    def borrow(context: Any, builder: Any, kind: Any, value: Any) -> Any:
        if isinstance(kind, types.BaseTuple):
            for k, own in enumerate(kind):  # type: ignore[arg-type, var-annotated]
                value = builder.insert_value(value, borrow(context, builder, own, builder.extract_value(value, k)), k)
        elif isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder, value)
            array.meminfo = array.meminfo.type(None)
            value = array._getvalue()
        return value

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return borrow(context, builder, signature.args[0], arguments[0])

    return held(held), generate


borrowed: Any = (lambda held: held) if numba.config.DISABLE_JIT else intrinsic(_borrowed)  # type: ignore[attr-defined]


def _next_task(typing: Any, turn: Any) -> Any:
    """next_task(turn): add one to the only number of an array (1,) int64, and return what it was before.

    Of several threads, each gets a number of its own.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.atomic_rmw("add", array.data, context.get_constant(types.int64, 1), "monotonic")

    return types.int64(turn), generate


def _next_of_threads(turn: Any) -> int:
    with _taking:
        turn[0] += 1
        return int(turn[0]) - 1


_taking = Lock()
next_task: Any = _next_of_threads if numba.config.DISABLE_JIT else intrinsic(_next_task)  # type: ignore[attr-defined]
