"""Morton codes: the path from an octree's root to a voxel, three bits a level.

x = ..dcba   ->   dilate(x) = ..00d00c00b00a        code = dilate(x) | dilate(y) << 1 | dilate(z) << 2
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def dilate(x: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Each number's bits (21 at most) with two zeros between them.

    x                     0 .. 2^21 - 1
    x | x << 32, masked   in groups of 16 and fewer bits
    ... 16, 8, 4, 2       in groups of 8, 4, 2 and 1
    """
    x = (x | x << 32) & 0x001F00000000FFFF
    x = (x | x << 16) & 0x001F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249
