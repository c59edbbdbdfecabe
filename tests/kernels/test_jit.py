"""The compiler of all kernels."""

from __future__ import annotations

import numba

from nerfbake.kernels.jit import compiling


def test_the_seconds_of_the_compiler_are_told_apart() -> None:
    before = compiling()
    double = numba.njit(lambda x: x * 2)  # kept nowhere, so that every run compiles it
    assert compiling() == before
    assert double(2.0) == 4.0
    first = compiling()
    assert first.worked > before.worked
    assert first.passed > before.passed
    assert double(3.0) == 6.0
    assert compiling() == first
