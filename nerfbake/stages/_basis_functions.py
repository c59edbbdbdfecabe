"""Values of a field's basis functions in given directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Points
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.scene.basis import Basis


def basis_at(basis: Basis, directions: Points, dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Return the basis functions (m, B) at directions (m, 3), in the field's own axes.

    The only function of RGBA is 1 everywhere.
    """
    if basis.kind == "RGBA":
        return np.ones((len(directions), 1), dtype)
    return sh_basis(directions, basis.size, dtype)
