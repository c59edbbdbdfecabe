"""What every part of a page is made with: texts of the package's own, and the ball around a scene."""

from __future__ import annotations

import pkgutil

import numpy as np
import numpy.typing as npt


def part_of(name: str, folder: str = "shaders/page") -> str:
    """A text of the package's own, from wherever it was imported."""
    data = pkgutil.get_data("nerfbake", f"{folder}/{name}")
    assert data is not None
    return data.decode()


def ball_of(corners: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """The middle of a box of opposite corners (2, 3), and how far away from it these are."""
    return corners.mean(axis=0), float(np.sqrt(((corners[1] - corners[0]) ** 2).sum())) / 2
