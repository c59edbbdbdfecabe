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


def test_views_are_reduced_with_their_cameras() -> None:
    cameras = Cameras((Camera(6, 5, 5.0, np.eye(4), "front"),))
    views = Views(cameras, (np.arange(120, dtype=np.uint8).reshape(5, 6, 4),), (1.0, 1.0, 1.0), True)
    assert views.reduced(1) is views
    half = views.reduced(2)
    assert (half.cameras.cameras[0].width, half.cameras.cameras[0].fx, half.masked) == (3, 2.5, True)
    assert half.pictures[0].shape == (2, 3, 4)
