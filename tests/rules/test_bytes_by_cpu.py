"""Outputs do not depend on the CPU: no CPU-specific functions in the layers that compute them."""

from __future__ import annotations

import ast

import pytest

from tests.support.source import PACKAGE, parsed

# Functions of NumPy, BLAS or the C library whose last bits depend on the CPU.
BY_CPU = {"arccos", "arcsin", "arctan", "arctan2", "cbrt", "cos", "cosh", "dot", "einsum", "exp", "exp2", "expm1"}
BY_CPU |= {"hypot", "inner", "log", "log10", "log1p", "log2", "matmul", "sin", "sinh", "tan", "tanh", "tensordot"}


@pytest.mark.parametrize("layer", ["kernels", "scene", "stages", "formats"])
def test_what_is_written_does_not_hang_on_the_cpu(layer: str) -> None:
    found = []
    for path in sorted((PACKAGE / layer).rglob("*.py")):
        for node in ast.walk(parsed(path)):
            place = f"{path.name}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
                found.append(f"{place} @")
            if isinstance(node, ast.Attribute):
                name = ast.unparse(node)
                if name.removeprefix("np.") in BY_CPU and name.startswith("np."):
                    found.append(f"{place} {name}")
                if name.startswith("np.linalg.") and name != "np.linalg.norm":
                    found.append(f"{place} {name}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.linalg.norm":
                # With an axis, norm() sums squares in order. Without one, it calls BLAS.
                found += [] if any(word.arg == "axis" for word in node.keywords) else [f"{place} np.linalg.norm"]
            if isinstance(node, ast.keyword) and node.arg == "fastmath":
                found.append(f"{place} fastmath")
    assert found == []
