"""Memory that a kernel will want soon: the CPU fetches it while the work before it goes on."""

from __future__ import annotations

from typing import Any

import numba
from numba.core import cgutils, types
from numba.extending import intrinsic

SINGLES = 16  # float32 of a line, which comes as a whole


def _prefetch(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """prefetch(array, row, column), of an array (n, k): asks for the line around an element, and waits for nothing.

    LLVM's own, which is an instruction of every x86-64 and ARM. It changes no value, and is passed over where kernels
    are ordinary functions.
    """
    tools: Any = cgutils  # numba tells no types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind, number = signature.args[0], tools.int32_t
        held = context.make_array(kind)(context, builder, arguments[0])
        place = tools.get_item_pointer(context, builder, kind, held, arguments[1:], wraparound=False)
        place = builder.bitcast(place, tools.voidptr_t)
        called = tools.ir.FunctionType(tools.ir.VoidType(), [place.type, number, number, number])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [place.type], called)
        builder.call(fetch, [place, number(0), number(3), number(1)])  # to be read, often, as data
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp), generate


prefetch: Any = (lambda array, row, column: None) if numba.config.DISABLE_JIT else intrinsic(_prefetch)  # type: ignore[attr-defined]
