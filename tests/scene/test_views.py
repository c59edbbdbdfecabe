from __future__ import annotations

import numpy as np
import pytest

from nerfbake import Camera, Cameras, Views
from nerfbake.errors import InvalidScene


def test_pictures_that_are_not_their_cameras_are_refused() -> None:
    cameras = Cameras((Camera(4, 3, 5.0, np.eye(4), "front"),))
    with pytest.raises(InvalidScene, match="pictures are 0; allowed: 1, one per camera"):
        Views(cameras, (), (1.0, 1.0, 1.0), True)
    with pytest.raises(
        InvalidScene, match=r"picture front has shape \(4, 3, 4\), dtype uint8; allowed: \(3, 4, 4\) uint8"
    ):
        Views(cameras, (np.zeros((4, 3, 4), np.uint8),), (1.0, 1.0, 1.0), True)
