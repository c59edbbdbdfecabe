"""What a reader must find in a file, in float64: numbers for each splat in the scene, and a picture."""

from __future__ import annotations

import io
import math

import numpy as np
import PIL.Image

from tests.conformance.gaussian_splatting.container import Json
from tests.conformance.gaussian_splatting.scenes import EDGE, FOV, POSE, Part, Scene
from tests.conformance.voxels import harmonics

# Unit vectors of fractions, none along an axis or in a plane of symmetry but the first.
DIRECTIONS = [
    [0.0, 0.0, -1.0],
    [2 / 7, 3 / 7, 6 / 7],
    [-6 / 7, 2 / 7, -3 / 7],
    [3 / 7, -6 / 7, -2 / 7],
    [-4 / 9, -1 / 9, 8 / 9],
]
DIGITS = 9  # of the numbers in the JSON
BLUR = 0.3  # square pixels
LEAST = 1 / 255  # alpha


def rotation_of(quat: np.ndarray) -> np.ndarray:
    """The rotation of a quaternion x y z w of any length."""
    x, y, z, w = quat / np.sqrt((quat * quat).sum())
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


class Splat:
    """A splat in the scene. turn: the rotation from its node, by which its SH are turned."""

    def __init__(self, part: Part, row: int) -> None:
        linear = part.matrix[:3, :3]
        single = {
            key: np.asarray(part.splats[key][row], np.float32).astype(np.float64) for key in ("rotations", "scales")
        }
        self.mean = linear @ np.asarray(part.splats["positions"][row], np.float64) + part.matrix[:3, 3]
        axes = linear @ rotation_of(single["rotations"]) * single["scales"]
        self.covariance = axes @ axes.T
        self.opacity = float(part.splats["opacities"][row])
        self.sh = np.asarray(part.splats["sh"][row], np.float32).astype(np.float64)
        self.turn = linear / np.sqrt((linear * linear).sum(axis=0))

    def colour(self, direction: np.ndarray) -> np.ndarray:
        """Red, green and blue in a direction from the camera to the splat, in the splats' colour space."""
        own = self.turn.T @ direction
        return np.maximum(np.array(harmonics(len(self.sh), own.tolist())) @ self.sh + 0.5, 0)


def splats_of(scene: Scene) -> list[Splat]:
    return [Splat(part, row) for part in scene.parts for row in range(len(part.splats["positions"]))]


def numbers_of(scene: Scene) -> Json:
    """The JSON beside a file."""
    return {
        "about": scene.about,
        "colorSpace": "lin_rec709_display" if scene.linear else "srgb_rec709_display",
        "degrees": [math.isqrt(len(part.splats["sh"][0])) - 1 for part in scene.parts],
        "directions": [[_short(v) for v in way] for way in DIRECTIONS],
        "splats": [
            {
                "mean": _list(each.mean),
                "covariance": _list(each.covariance[np.triu_indices(3)]),
                "opacity": _short(each.opacity),
                "colors": [_list(each.colour(np.array(way))) for way in DIRECTIONS],
            }
            for each in splats_of(scene)
        ],
    }


def _short(value: float) -> float:
    return round(float(value), DIGITS) + 0.0


def _list(values: np.ndarray) -> list[float]:
    return [_short(value) for value in values]


def picture_of(scene: Scene) -> np.ndarray:
    """(EDGE, EDGE, 3) float64, sRGB: the splats before black, as README.md describes it."""
    focal = EDGE / 2 / math.tan(FOV / 2)
    eye, splats = POSE[:3, 3], splats_of(scene)
    splats.sort(key=lambda splat: float(((splat.mean - eye) ** 2).sum()))
    down, right = np.mgrid[0:EDGE, 0:EDGE] + 0.5
    passed, light = np.ones((EDGE, EDGE)), np.zeros((EDGE, EDGE, 3))
    for splat in splats:
        way = splat.mean - eye
        view = (POSE[:3, :3] * [1, -1, -1]).T  # x right, y down, z forward
        x, y, z = view @ way
        J = np.array([[focal / z, 0, -focal * x / z**2], [0, focal / z, -focal * y / z**2]]) @ view
        a, b, c = (J @ splat.covariance @ J.T + BLUR * np.eye(2))[np.triu_indices(2)]
        u, v = right - (focal * x / z + EDGE / 2), down - (focal * y / z + EDGE / 2)
        square = (c * u * u - 2 * b * u * v + a * v * v) / (a * c - b * b)
        alpha = splat.opacity * np.exp(-square / 2)
        alpha[alpha < LEAST] = 0
        light += (passed * alpha)[..., None] * splat.colour(way / np.sqrt((way * way).sum()))
        passed *= 1 - alpha
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055) if scene.linear else light


def png_of(picture: np.ndarray) -> bytes:
    file = io.BytesIO()
    PIL.Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(file, "PNG", optimize=True)
    return file.getvalue()
