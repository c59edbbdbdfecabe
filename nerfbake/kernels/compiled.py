"""Functions for arrays that kernels call, too: compiled here, because their own modules load without numba."""

from __future__ import annotations

from typing import Any

from nerfbake.kernels.jit import compiled
from nerfbake.kernels.march.sh import fill_basis
from nerfbake.kernels.maths.elementary import exp_parts

compiled_exp_parts: Any = compiled()(exp_parts)
compiled_fill_basis: Any = compiled()(fill_basis)
