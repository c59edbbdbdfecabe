"""Small pictures of the sample scene with their cameras."""

from __future__ import annotations

from functools import cache

from nerfbake import Cameras, Views, build_field, orbit_cameras, render_field, sample_n3tree
from nerfbake.scene.camera import Camera, look_at
from nerfbake.scene.lens import Lens


@cache
def sample_views(
    frames: int = 12, width: int = 64, height: int = 64, *, resolution: int = 32, lens: Lens | None = None
) -> Views:
    """Views from all sides and two elevations, with alpha, over white."""
    scene = build_field(sample_n3tree(resolution=resolution))
    own = orbit_cameras(scene, width=width, height=height).cameras[0]
    centre = (scene.world(scene.box)).mean(axis=0)
    away = float(((own.pose[:3, 3] - centre) ** 2).sum() ** 0.5)
    cameras = []
    for i in range(frames):
        pose = look_at(centre, 6.2831853 * i / frames, (0.3, 0.9)[i % 2], away)
        cameras.append(Camera(width, height, own.focal, pose, f"{i:02d}", lens=lens))
    pictures = tuple(render_field(scene, camera, background=None).pixels for camera in cameras)
    return Views(Cameras(tuple(cameras)), pictures, (1.0, 1.0, 1.0), True)
