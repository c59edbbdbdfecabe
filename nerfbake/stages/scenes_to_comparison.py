"""Two scenes seen by the same cameras -> how far they are apart, in pictures and in values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import BudgetMissed, InvalidScene, Problem
from nerfbake.kernels.metrics import psnr, ssim
from nerfbake.scene.camera import Cameras
from nerfbake.scene.image import Image
from nerfbake.stages._field import Radiance, field_of
from nerfbake.stages._picture import Scene, picture

MAX_POINTS = 200_000  # leaves whose values are compared
_GAP = 4  # pixels between the pictures of the sheet
_AMPLIFIED = 8.0  # the sheet's differences


@dataclass(frozen=True, eq=False)
class Comparison:
    """views: for each camera its name and {psnr, ssim, max_error} of a against b, and of both against the truth.

    values   {sigma, dc, higher}: mean and largest absolute difference at the centres of a's leaves
    pictures for each camera the truth (or None), a and b, over white
    """

    views: tuple[dict[str, Any], ...]
    values: dict[str, Any]
    pictures: tuple[tuple[Image | None, Image, Image], ...]

    @property
    def means(self) -> dict[str, Any]:
        """The views' means, and the largest of their errors."""
        found = {}
        for pair in [key for key in self.views[0] if key != "name"]:
            columns = {key: [view[pair][key] for view in self.views] for key in self.views[0][pair]}
            found[pair] = {key: float(np.mean(column)) for key, column in columns.items()}
            found[pair]["max_error"] = max(columns["max_error"])
        return found

    def require(self, *, min_psnr: float | None = None, max_error: float | None = None) -> None:
        """Raises BudgetMissed if b's mean PSNR against a is lower (dB), or a pixel's channel further off (0..1)."""
        psnr, error = self.means["a_b"]["psnr"], self.means["a_b"]["max_error"]
        if min_psnr is not None and not psnr >= min_psnr:
            raise BudgetMissed(Problem("the picture", f"has a mean PSNR of {psnr:.2f} dB", f"--min-psnr {min_psnr:g}"))
        if max_error is not None and not error <= max_error:
            raise BudgetMissed(Problem("the picture", f"is off by {error:.4f}", f"--max-error {max_error:g}"))

    @property
    def sheet(self) -> Image:
        """A row for each camera: truth, a, b, and their difference, eight times as strong."""
        rows = []
        for truth, a, b in self.pictures:
            difference = np.clip(_AMPLIFIED * np.abs(a.colour - b.colour), 0, 1)
            shown = [image.colour for image in (truth, a, b) if image is not None] + [difference]
            rows.append(np.concatenate([_framed(picture) for picture in shown], axis=1))
        colour = np.concatenate(rows, axis=0)
        whole = np.ones(colour.shape[:2], np.float32)
        return Image(colour, whole, np.zeros_like(whole))


def compare(a: Scene, b: Scene, cameras: Cameras, *, truth: Sequence[Image] | None = None) -> Comparison:
    """Renders both scenes with every camera, over white, and measures them. truth: a photograph for each camera.

    Errors are on sRGB in 0..1, before rounding to 8 bits. Raises InvalidScene for scenes that cannot be rendered, and
    for photographs of another number or size than the cameras'.
    """
    if truth is not None and len(truth) != len(cameras.cameras):
        raise InvalidScene(Problem("truth", f"has {len(truth)} pictures", f"{len(cameras.cameras)}, one a camera"))
    views, pictures = [], []
    for i, camera in enumerate(cameras.cameras):
        seen = {"a": picture(a, camera), "b": picture(b, camera)}
        view: dict[str, Any] = {"name": camera.name, "a_b": _errors(seen["a"], seen["b"])}
        photograph = None
        if truth is not None:
            photograph = truth[i].over((1.0, 1.0, 1.0))
            if photograph.alpha.shape != (camera.height, camera.width):
                height, width = photograph.alpha.shape
                found = f"has {width}x{height} pixels"
                raise InvalidScene(Problem(f"truth of {camera.name}", found, f"{camera.width}x{camera.height}"))
            view |= {f"{name}_truth": _errors(image, photograph) for name, image in seen.items()}
        views.append(view)
        pictures.append((photograph, seen["a"], seen["b"]))
    return Comparison(tuple(views), _value_errors(a, b), tuple(pictures))


def _errors(a: Image, b: Image) -> dict[str, float]:
    x, y = a.colour.astype(np.float64), b.colour.astype(np.float64)
    return {"psnr": psnr(x, y), "ssim": ssim(x, y), "max_error": float(np.abs(x - y).max())}


def _value_errors(a: Scene, b: Scene) -> dict[str, Any]:
    if not (isinstance(a, Radiance) and isinstance(b, Radiance)):
        return {}
    one, other = field_of(a), field_of(b)
    if one.basis != other.basis:
        return {}
    points = one.leaf_centres(MAX_POINTS)
    difference = np.abs(one.sample(points) - other.sample(points))
    colours = difference[:, :-1].reshape(len(points), 3, one.basis.size)
    parts = {"sigma": difference[:, -1], "dc": colours[..., 0], "higher": colours[..., 1:]}
    return {name: _mean_and_max(part) for name, part in parts.items() if part.size}


def _mean_and_max(values: npt.NDArray[np.float32]) -> dict[str, float]:
    return {"mean": float(values.mean(dtype=np.float64)), "max": float(values.max())}


def _framed(picture: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return np.pad(picture, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=np.float32(1))
