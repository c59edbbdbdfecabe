"""The difference between two scenes in pictures from the same cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import BudgetMissed, Problem
from nerfbake.kernels.picture import drawing
from nerfbake.scene.base import Scene
from nerfbake.scene.image import GAP, Image

AMPLIFIED = 8  # factor of the difference pictures
TITLES = {"truth": "TRUTH", "a": "IN", "b": "IN2"}
TITLES |= {pair: f"{AMPLIFIED} X {TITLES[pair[0]]}-{TITLES[pair[2:]]}" for pair in ("a_b", "a_truth", "b_truth")}


class Verdict(NamedTuple):
    """A quality limit (the name of an argument), the value found, the value allowed, and whether it is met."""

    budget: str
    found: float
    allowed: float
    holds: bool
    problem: Problem


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Scene):
    """views: for each camera its name and {psnr, ssim, max_error} of a against b, and of both against the truth.

    values   {sigma, dc, higher}: mean and largest absolute difference at the centres of a's leaves; {} if the two
             scenes store different kinds of values
    pictures for each camera the truth (or None), a and b, over white; () if they were not kept
    samples  the pictures of a and b have samples x samples rays per pixel

    >>> from nerfbake import build_field, build_octree, compare_scenes, orbit_cameras, sample_n3tree
    >>> tree = sample_n3tree(resolution=8)
    >>> views = orbit_cameras(build_field(tree), width=16, height=12)
    >>> found = compare_scenes(tree, build_octree(tree), views)
    >>> [verdict.holds for verdict in found.judge(min_psnr=40.0)]
    [True]
    """

    views: tuple[dict[str, Any], ...]
    values: dict[str, Any]
    pictures: tuple[tuple[Image | None, Image, Image], ...]
    samples: int = 1

    @property
    def means(self) -> dict[str, Any]:
        """The means over all views, and the maximum of max_error."""
        found = {}
        for pair in [key for key in self.views[0] if key != "name"]:
            columns = {key: [view[pair][key] for view in self.views] for key in self.views[0][pair]}
            found[pair] = {key: float(np.mean(column)) for key, column in columns.items()}
            found[pair]["max_error"] = max(columns["max_error"])
        return found

    def judge(self, *, min_psnr: float | None = None, max_error: float | None = None) -> list[Verdict]:
        """Check each limit that is set: b's mean PSNR against a (dB), and the largest error of a channel (0..1)."""
        verdicts = []
        psnr, error = self.means["a_b"]["psnr"], self.means["a_b"]["max_error"]
        if min_psnr is not None:
            problem = Problem("the picture", f"has a mean PSNR of {psnr:.2f} dB", f"`min_psnr={min_psnr:g}`")
            verdicts.append(Verdict("min_psnr", psnr, min_psnr, psnr >= min_psnr, problem))
        if max_error is not None:
            problem = Problem("the picture", f"is off by {error:.4f}", f"`max_error={max_error:g}`")
            verdicts.append(Verdict("max_error", error, max_error, error <= max_error, problem))
        return verdicts

    def require(self, *, min_psnr: float | None = None, max_error: float | None = None) -> None:
        """Raise BudgetMissed for the first limit that is missed."""
        for verdict in self.judge(min_psnr=min_psnr, max_error=max_error):
            if not verdict.holds:
                raise BudgetMissed(verdict.problem)

    def rows(self) -> Iterator[dict[str, Image]]:
        """For each camera its pictures by name, in order: truth (if there is one), a, b; then the differences.

        The differences are multiplied by AMPLIFIED and named a_b, a_truth, b_truth, as in `views`.
        """
        for truth, a, b in self.pictures:
            if truth is None:
                yield {"a": a, "b": b, "a_b": _difference(a, b)}
            else:
                errors = {"a_b": _difference(a, b), "a_truth": _difference(a, truth), "b_truth": _difference(b, truth)}
                yield {"truth": truth, "a": a, "b": b, **errors}

    @property
    def sheet(self) -> Image:
        """A contact sheet of all pictures, one row per camera, with a title above each column."""
        rows = list(self.rows())
        tiled = Image.tiled([image for row in rows for image in row.values()], columns=len(rows[0]))
        edge = max(image.size[0] for row in rows for image in row.values()) + GAP
        colour = np.concatenate([_titles(list(rows[0]), edge, tiled.size[0]), tiled.colour])
        whole = np.ones(colour.shape[:2], np.float32)
        return Image(colour, whole, np.zeros_like(whole))


def _difference(a: Image, b: Image) -> Image:
    colour = np.clip(AMPLIFIED * np.abs(a.colour - b.colour), 0, 1)
    whole = np.ones_like(a.alpha)
    return Image(colour, whole, np.zeros_like(whole))


def _titles(names: list[str], edge: int, width: int) -> npt.NDArray[np.float32]:
    """(h, width, 3) black text on white, one name at the left of each column."""
    texts = [TITLES[name] for name in names]
    scale = max(1, min((edge - GAP) // (max(map(len, texts)) * drawing.ADVANCE), 2))
    colour = np.ones((scale * drawing.HEIGHT + 2 * GAP, width, 3), np.float32)
    for i, text in enumerate(texts):
        letters = np.kron(drawing.letter_dots(text), np.ones((scale, scale), bool))[:, : edge - GAP]
        letters = letters[:, : width - i * edge]
        colour[GAP : GAP + len(letters), i * edge : i * edge + letters.shape[1]][letters] = 0
    return colour
