"""A fit of panoramas: pictures of all directions, from places in a room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Camera, Cameras, render_room, save
from nerfbake.jobs import FitOptions, fit_file
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.lens import all_round
from nerfbake.stages._scenery import inner_cube_of, sees
from nerfbake.stages.views_to_error import plain_psnr

WIDTH = 48


def panoramas(folder: Path, frames: int = 8) -> Cameras:
    """Pictures of the room from a circle around the table, each turned about the vertical in its own way."""
    focal, centre, lens = all_round(WIDTH, WIDTH // 2)
    cameras = []
    for i in range(frames):
        angle, turn = 2 * np.pi * i / frames, 2.5 * i
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [np.sin(turn), 0, -np.cos(turn)], [0, 1, 0]]
        pose[:3, 3] = 1.1 * np.cos(angle), 1.1 * np.sin(angle), 1.1 + 0.3 * np.sin(3 * angle)
        camera = Camera(WIDTH, WIDTH // 2, focal, pose, f"images/{i}.png", centre, lens)
        cameras.append(camera)
        (folder / "images").mkdir(parents=True, exist_ok=True)
        Pillow.fromarray(render_room(camera, samples=2).pixels).save(folder / f"images/{i}.png")
    save(folder / "transforms.json", Cameras(tuple(cameras)))
    return Cameras(tuple(cameras))


@pytest.mark.slow
def test_a_fit_of_panoramas_shows_the_room_from_other_places(tmp_path: Path) -> None:
    cameras = panoramas(tmp_path)
    box = inner_cube_of(cameras)
    assert ((cameras.eyes > box[0]) & (cameras.eyes < box[1])).all()
    assert sees(cameras.cameras[0], np.add(cameras.eyes, [0, 0, 50.0]), 0.1).all()
    options = FitOptions(epochs="cells=32,scale=1,epochs=12,rays=1,split=0,prune=0.03", basis="SH1")
    fitted = fit_file(tmp_path, tmp_path / "room.npz", options=options)
    held_out = read_photographs(SILENT, Source(str(tmp_path))).held_out
    assert fitted.psnr > plain_psnr(held_out) + 3
