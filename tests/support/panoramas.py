"""Panoramas of the sample room: pictures of all directions, whose poses are known."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from PIL.PngImagePlugin import PngInfo

from nerfbake import Camera, Cameras, render_room
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import rotate
from nerfbake.scene.lens import all_round

GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>'
)
ALL_ROUND = GPANO.format('GPano:ProjectionType="equirectangular"')


def tagged(size: tuple[int, int], packet: str, kind: str = "JPEG") -> bytes:
    """A grey picture with this XMP packet."""
    file, picture = io.BytesIO(), Pillow.new("L", size, 128)
    if kind == "PNG":
        chunks = PngInfo()
        chunks.add_itxt("XML:com.adobe.xmp", packet)
        picture.save(file, "PNG", pnginfo=chunks)
    else:
        picture.convert("RGB").save(file, kind, xmp=packet.encode())
    return file.getvalue()


def panorama_cameras(frames: int, width: int) -> Cameras:
    """Cameras on a ring around the table, each turned about the vertical and tilted in its own way."""
    focal, centre, lens = all_round(width, width // 2)
    random, cameras = np.random.default_rng(5), []
    for i in range(frames):
        angle, turn, tilt = 2 * np.pi * i / frames, *random.uniform(0, [2 * np.pi, 0.15])
        pose = np.eye(4)
        upright = np.array([[np.cos(turn), 0, np.sin(turn)], [np.sin(turn), 0, -np.cos(turn)], [0, 1, 0]])
        tilted = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        pose[:3, :3] = rotate(tilted.T, upright).T
        pose[:3, 3] = 1.1 * np.cos(angle), 1.1 * np.sin(angle), 1.3 + 0.3 * np.sin(3 * angle)
        cameras.append(Camera(width, width // 2, focal, pose, f"{i:02d}.jpg", centre, lens))
    return Cameras(tuple(cameras))


def write_panoramas(folder: Path, *, frames: int, width: int, packet: str = "") -> Cameras:
    """Write the pictures of these cameras to the folder, and return the cameras."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = panorama_cameras(frames, width)
    for camera in cameras.cameras:
        picture = Pillow.fromarray(render_room(camera, samples=2).pixels)
        picture.convert("RGB").save(folder / camera.name, quality=95, xmp=packet.encode())
    return cameras


def sighting_errors(cameras: Cameras) -> Floats:
    """Degrees between the direction of a sparse point and the pixel that shows it, for each place of a point."""
    assert cameras.points is not None
    errors = []
    for i, camera in enumerate(cameras.cameras):
        assert camera.lens is not None
        own = cameras.points.camera == i
        slopes = (cameras.points.pixel[own] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        looks, _ = camera.lens.looks(slopes)
        away = rotate(cameras.points.positions[cameras.points.point[own]] - camera.pose[:3, 3], camera.pose[:3, :3].T)
        away *= np.array([1, -1, -1]) / np.linalg.norm(away, axis=1)[:, None]
        errors.append(np.degrees(np.arccos(np.clip((looks * away).sum(axis=1), -1, 1))))
    return np.concatenate(errors)
