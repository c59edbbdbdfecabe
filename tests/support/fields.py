"""Fields that are small enough to check by hand, and a camera in front of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake import (
    Camera,
    RadianceField,
    build_field,
)
from nerfbake.scene.camera import look_at
from tests.support.scenes import n3tree


def solid(sigma: float, red: float = 0.0, **fields: Any) -> RadianceField:
    """The unit cube with constant density. Colours are the sigmoid of (red, 0, 0)."""
    data = np.zeros((1, 2, 2, 2, 4), np.float32)
    data[..., 0], data[..., 3] = red, sigma
    return build_field(n3tree(data=data, data_format="RGBA", **fields))


def front(edge: int = 5, distance: float = 3.0) -> Camera:
    """A camera that looks along +y at the centre of the unit cube. Its middle ray is normal to the face."""
    return Camera(edge, edge, 4.0 * edge, look_at(np.full(3, 0.5), -np.pi / 2, 0, distance), "front")
