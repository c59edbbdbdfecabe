"""Cameras: one for all frames, each frame its own, lenses, and a capture's folder."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerfbake import load
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.lens import Lens
from tests.conformance.case import Case, Facts, Frozen, floats, form_named

# Right-handed, of length 1, in fractions that float64 has: (0.6, 0.8) is a turn.
FRONT = [[1, 0, 0, 0.5], [0, 1, 0, -0.25], [0, 0, 1, 4], [0, 0, 0, 1]]
SIDE = [[0.8, 0, 0.6, 3], [0, 1, 0, 0.5], [-0.6, 0, 0.8, 2], [0, 0, 0, 1]]
ABOVE = [[0, 1, 0, 0], [-0.6, 0, 0.8, 4], [0.8, 0, 0.6, 3], [0, 0, 0, 1]]


def scenes() -> dict[str, Cameras]:
    front, side, above = (np.array(pose, np.float64) for pose in (FRONT, SIDE, ABOVE))
    lens = Lens("polynomial", (0.05, -0.01), (0.001, -0.002))
    wide = Lens("fisheye", (0.02, -0.003, 0.0005))
    both = Lens("rational", (0.1, 0.02, 0.0, 0.05, 0.01, 0.001), (0.0005, 0.001))
    return {
        "shared": Cameras((Camera(8, 6, 10.0, front, "r_0"), Camera(8, 6, 10.0, side, "r_1"))),
        "own": Cameras((Camera(8, 6, (10.0, 9.5), front, "0001", (4.25, 2.5)), Camera(5, 7, 6.0, above, "0002"))),
        "lenses": Cameras(
            (
                Camera(8, 6, 10.0, side, "polynomial", None, lens),
                Camera(9, 7, (5.0, 5.5), front, "fisheye", (4.0, 3.75), wide),
                Camera(8, 6, 12.0, above, "rational", None, both),
            )
        ),
    }


def cases() -> Iterator[Case]:
    for name, cameras in scenes().items():
        files = {f"camera/{name}.json": Frozen(form_named("json"), cameras)}
        yield Case(f"camera/{name}", "Cameras as transforms.json has them.", files, facts_of(cameras), answer)
    shared = scenes()["shared"]
    files = {"camera/capture": Frozen(form_named("transforms"), shared)}
    yield Case("camera/capture", "A capture's folder, without its pictures.", files, facts_of(shared), answer)


def facts_of(cameras: Cameras) -> Facts:
    return {"cameras": [{**_told(camera), "rays": _rays(camera)} for camera in cameras.cameras]}


def _told(camera: Camera) -> Facts:
    lens = camera.lens
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "focal": [camera.fx, camera.fy],
        "centre": [camera.cx, camera.cy],
        "lens": None if lens is None else {"model": lens.model, "k": list(lens.k), "p": list(lens.p)},
        "camera_to_world": floats(camera.pose),
    }


def _pixels(camera: Camera) -> list[tuple[int, int]]:
    return [(0, 0), (camera.width - 1, 0), (camera.width // 2, camera.height // 2), (1, camera.height - 1)]


def _rays(camera: Camera) -> list[Facts]:
    pose, rays = camera.pose.tolist(), []
    for column, row in _pixels(camera):
        x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
        look = [x, y, 1.0] if camera.lens is None else _look(camera.lens, x, y)
        seen = [look[0], -look[1], -look[2]]  # the picture's y points down, the camera looks along its -z
        direction = [sum(a * s for a, s in zip(line[:3], seen, strict=True)) for line in pose[:3]]
        length = math.sqrt(sum(d * d for d in direction))
        rays.append(
            {
                "pixel": [column, row],
                "origin": [line[3] for line in pose[:3]],
                "direction": [d / length for d in direction],
            }
        )
    return rays


def _look(lens: Lens, u: float, v: float) -> list[float]:
    """Where to look to see (u, v) on the picture's plane: the distortion undone by repetition, as it is small."""
    x, y = u, v
    k, (p1, p2) = [*lens.k, *[0.0] * 6], lens.p
    for _ in range(200):
        s = x * x + y * y
        if lens.model == "rational":
            scale = (1 + k[0] * s + k[1] * s**2 + k[2] * s**3) / (1 + k[3] * s + k[4] * s**2 + k[5] * s**3)
        else:
            scale = 1 + k[0] * s + k[1] * s**2 + k[2] * s**3 + k[3] * s**4
        aside, down = 2 * p1 * x * y + p2 * (s + 2 * x * x), p1 * (s + 2 * y * y) + 2 * p2 * x * y
        x, y = (u - aside) / scale, (v - down) / scale
    if lens.model != "fisheye":
        return [x, y, 1.0]
    angle = math.hypot(x, y)
    return [x * math.sin(angle) / angle, y * math.sin(angle) / angle, math.cos(angle)]


def answer(path: Path, expected: Facts) -> Facts:
    found = []
    for camera, told in zip(load(path, Cameras).cameras, expected["cameras"], strict=True):
        origin, directions = camera.rays()
        rays = [
            {"pixel": [x, y], "origin": origin.tolist(), "direction": directions[y * camera.width + x].tolist()}
            for x, y in (ray["pixel"] for ray in told["rays"])
        ]
        found.append({**_told(camera), "rays": rays})
    return {"cameras": found}
