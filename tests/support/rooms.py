"""Small photographs of the sample room without cameras, whose poses can be found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from nerfbake import orbit_room, render_room

Array = npt.NDArray[np.float64]
WIDTH, HEIGHT = 240, 180
FOCAL = orbit_room(frames=1, width=WIDTH, height=HEIGHT).cameras[0].fx


def write_room(folder: Path, *, frames: int = 8, first: int = 0) -> Array:
    """Write NNNN.png to the folder, and return the positions of the cameras, (frames, 3).

    first: the number of the first picture; rooms with different numbers have different textures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras = orbit_room(frames=frames, width=WIDTH, height=HEIGHT).cameras
    for i, camera in enumerate(cameras):
        picture = render_room(camera, seed=first, samples=2)
        Pillow.fromarray(picture.pixels).save(folder / f"{first + i:04d}.png")
    return np.array([camera.pose[:3, 3] for camera in cameras])
