"""Fields that are small enough to check by hand, and a camera in front of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake import Camera, PageField, RadianceField, build_field, round_field
from nerfbake.scene.camera import look_at
from tests.support.scenes import n3tree, voxel_centres


def solid(sigma: float, red: float = 0.0, **fields: Any) -> RadianceField:
    """The unit cube with constant density. Colours are the sigmoid of (red, 0, 0)."""
    data = np.zeros((1, 2, 2, 2, 4), np.float32)
    data[..., 0], data[..., 3] = red, sigma
    return build_field(n3tree(data=data, data_format="RGBA", **fields))


def front(edge: int = 5, distance: float = 3.0) -> Camera:
    """A camera that looks along +y at the centre of the unit cube. Its middle ray is normal to the face."""
    return Camera(edge, edge, 4.0 * edge, look_at(np.full(3, 0.5), -np.pi / 2, 0, distance), "front")


def assert_same_samples(found: PageField | RadianceField, field: RadianceField) -> None:
    """The rounded field at the centre of every voxel in its box, to the bit, and nothing outside of it."""
    low, high = np.floor(field.box[0]).astype(int), np.ceil(field.box[1]).astype(int)
    size = (high - low).tolist()
    points = field.world(low + voxel_centres((size[0], size[1], size[2])))
    assert found.sample(points).tobytes() == round_field(field).sample(points).tobytes()
    assert not found.sample(field.world(np.array([[-1e6] * 3, [1e6] * 3]))).any()
