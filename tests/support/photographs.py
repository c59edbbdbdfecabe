"""Photographs for captures: small ones that can be told apart, and those of a scene that can be fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from nerfbake import Cameras, build_field, load, orbit_cameras, render_field, sample_n3tree, save
from nerfbake.scene.camera import look_at
from tests.support.captures import Rig, rig

Pixels = npt.NDArray[np.uint8]


def spot(width: int, height: int, number: int = 0) -> Pixels:
    """(height, width, 4) a square on transparent black. Its red value encodes the number."""
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[height // 3 : height - height // 3, width // 3 : width - width // 3] = (10 * number, 200, 30, 255)
    return pixels


def over(pixels: Pixels, colour: tuple[int, int, int]) -> Pixels:
    """Composite RGBA pixels over a colour, and return RGB."""
    alpha = pixels[..., 3:] / 255
    return np.rint(pixels[..., :3] * alpha + np.array(colour) * (1 - alpha)).astype(np.uint8)


def write_picture(path: Path, pixels: Pixels) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.fromarray(pixels).save(path, "PNG")


def photographed(
    write: Callable[..., Path], folder: Path, made: Rig | None = None, paint: Callable[[Pixels], Pixels] | None = None
) -> Path:
    """Write a rig in a program's format with a spot() per picture, and return the folder. paint: changes each spot."""
    made = made or rig(odd=False)
    place = write(folder, made)
    for i, camera in enumerate(load(place, Cameras).cameras):
        pixels = spot(made.width, made.height, i)
        path = place / camera.picture
        write_picture(path if path.suffix else path.with_suffix(".png"), paint(pixels) if paint else pixels)
    return place


def write_scene(folder: Path, *, frames: int = 16, edge: int = 32) -> Path:
    """Write a NeRF-Synthetic capture of the sample scene: `frames` training views and a quarter as many test views."""
    field = build_field(sample_n3tree(resolution=16, basis="SH1"))
    box, (around,) = field.world(field.box), orbit_cameras(field, width=edge, height=edge).cameras
    centre = box.mean(axis=0)
    distance = float(np.linalg.norm(around.pose[:3, 3] - centre))
    for split, count in (("train", frames), ("test", frames // 4)):
        # The azimuth advances by the golden angle, while the elevation decreases.
        places = [(2.4 * i + 0.7 * (split == "test"), 1.2 - 1.6 * (i + 0.5) / count) for i in range(count)]
        cameras = [
            replace(around, pose=look_at(centre, *place, distance), name=f"{split}/{i:04d}")
            for i, place in enumerate(places)
        ]
        save(folder / f"transforms_{split}.json", Cameras(tuple(cameras)), parents=True)
        for camera in cameras:
            write_picture(folder / f"{camera.name}.png", render_field(field, camera, background=None).pixels)
    return folder
