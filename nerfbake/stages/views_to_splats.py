"""Splats and pictures with cameras -> splats whose pictures are like these."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import frexp

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles, as_input
from nerfbake.kernels.march.sh import band_of
from nerfbake.kernels.maths.elementary import power
from nerfbake.kernels.picture.reduction import reduced_picture
from nerfbake.kernels.splat.adam import Entries, Moments, StepSizes, new_moments, take_steps
from nerfbake.kernels.splat.backward import SUMS, TargetPicture, blend_back, entries_by_row
from nerfbake.kernels.splat.blend import TileLists
from nerfbake.kernels.splat.project import SEEN, SplatArrays, project
from nerfbake.kernels.splat.tiles import bent_tiles, count_entries, even_tiles, fill_entries
from nerfbake.scene.camera import Camera
from nerfbake.scene.packed_pictures import PackedPicture, PackedPictures
from nerfbake.scene.splats import Splats
from nerfbake.scene.views import Views
from nerfbake.stages._eye import eye_of

EPOCHS = 4
# Of antialiased splats, every fourth picture is fitted at half its size, so that they are right at other sizes, too.
# Others look different at other sizes: biker.spz, merged from 152,746 to 30,000, gets 41.3 dB without and 40.0 with
# them at the size of the pictures; at other sizes both were not compared.
_SMALL_EVERY = 4
_ALPHA = 0.1  # weight of the error of alpha, relative to that of a channel
# First and last step sizes. They fall geometrically. Chosen on the chair, fitted to 87 of its training photographs and
# measured on the other 13: 34.63 dB with half the sizes of means and SH and 0.12 for the higher bands, 34.76 with these
# sizes of SH, 34.79 also with these of means, 34.85 with all. Opacities twice or half as fast: 0.02 dB, 0.00 dB less.
_MEAN, _SCALE, _QUAT, _OPACITY, _SH = (0.08, 0.008), (0.02, 0.002), (0.02, 0.002), (0.1, 0.01), (0.04, 0.004)
_HIGHER_BANDS = 0.25  # of the step size of the first band
_LEAST_OPACITY, _LEAST_SCALE = 1e-3, 1e-9  # Adam cannot leave 0
_ROUNDING = 64
_SPLAT_BYTES = 400
_BASIS_BYTES = 36  # per coefficient of a splat: SH and their two moments
_ENTRY_BYTES = 60


@dataclass
class SplatFit:
    """The state of a fit.

    epoch, view: the number of the pass, and of pictures in it, that are done. error: the mean squared difference of the
    last picture, before the step. start: the splats before the fit. The arrays are changed in place by the next step.
    """

    start: Splats
    arrays: SplatArrays
    moments: Moments
    epoch: int = 0
    view: int = 0
    error: float = 0.0

    def splats(self) -> Splats:
        """A copy of the splats, without those that are too transparent to be drawn.

        Means are rounded to 1/64 of a small splat's size: the digits below are noise, which no format can compress.
        """
        keep = self.arrays.opacity >= SEEN
        if not keep.any():
            raise InvalidScene(Problem("the fit", "has no splat left that can be seen", "pictures of the scene"))
        means, scales, quats, opacity, sh = (array[keep] for array in self.arrays)
        small = float(np.sort(scales.max(axis=1))[len(scales) // 100])
        step = 2.0 ** (frexp(small / _ROUNDING)[1] - 1)  # a power of two, so that trailing bits are 0
        means = (np.rint(means / step) * step).astype(np.float32)
        fitted = replace(self.start, means=means, scales=scales, quats=quats, opacity=opacity, sh=sh)
        return memory.kept(fitted)


def fit_splats(splats: Splats, views: Views, *, epochs: int = EPOCHS, seed: int = 0) -> Iterator[SplatFit]:
    """Fit splats to pictures. Yields the state after every picture; each yield returns the same object.

    Adam on the squared difference of the colours, one picture a step; the splats that a picture does not show do not
    move. Their number stays. Antialiased splats look right at every size in programs that know the flag, and every
    fourth picture has half its size for them; others are best at the size of the pictures. For views with scenery, only
    pixels with alpha 255 count.

    The same arguments give the same bytes, for any number of threads. Raises InvalidScene, MemoryLimit. Source: 3D
    Gaussian Splatting (Kerbl et al., 2023) for the parameters and gradients; it needs no densification here, because
    the splats of build_splats() are where the surfaces are.

    >>> from nerfbake import build_field, build_splats, build_views, fit_splats, orbit_cameras, render_field
    >>> from nerfbake import sample_n3tree
    >>> scene = build_field(sample_n3tree(resolution=8))
    >>> cameras = orbit_cameras(scene, frames=4, width=24, height=24)
    >>> pictures = [render_field(scene, camera, background=None).pixels for camera in cameras.cameras]
    >>> views = build_views(cameras, pictures)
    >>> errors = [state.error for state in fit_splats(build_splats(scene), views, epochs=8)]
    >>> sum(errors[-4:]) < sum(errors[:4])
    True
    """
    splats.require_usable()
    views.cameras.require_covered()
    if epochs < 1:
        raise InvalidScene(Problem("epochs", f"are {epochs}", "1 or more"))
    memory.require(f"fitting {splats.n:,} splats", splats.n * (_SPLAT_BYTES + _BASIS_BYTES * splats.B))
    state = _started(splats)
    targets = PackedPictures(PackedPicture(_over(picture, views.background)) for picture in views.pictures)
    bands, alpha = band_of(splats.B), _ALPHA if views.masked and not views.scenery else 0.0
    count = len(targets)
    for epoch in range(epochs):
        order = np.random.default_rng([seed, epoch]).permutation(count)
        for done, number in enumerate(order):
            camera, pixels = views.cameras.cameras[number], targets[number]
            small = splats.antialiased and (epoch * count + done) % _SMALL_EVERY == _SMALL_EVERY - 1
            if small and min(pixels.shape[:2]) >= 2:
                camera, pixels = camera.reduced(2), _over(reduced_picture(views.pictures[number], 2), views.background)
            part = (epoch * count + done) / max(epochs * count - 1, 1)
            target = TargetPicture(as_input(pixels), np.array(views.background, np.float32), alpha, views.scenery)
            state.error = _visit(state, camera, target, _sizes(part, bands))
            state.epoch, state.view = divmod(epoch * count + done + 1, count)
            yield state


def _started(splats: Splats) -> SplatFit:
    means, scales, quats, sh = (each.copy() for each in (splats.means, splats.scales, splats.quats, splats.sh))
    opacity = np.clip(splats.opacity, np.float32(_LEAST_OPACITY), np.float32(1 - _LEAST_OPACITY))
    np.maximum(scales, np.float32(_LEAST_SCALE), out=scales)
    arrays = SplatArrays(means, scales, quats, opacity, sh)
    return SplatFit(splats, arrays, new_moments(arrays))


def _sizes(part: float, bands: npt.NDArray[np.int64]) -> StepSizes:
    """Return the step sizes after this part of the fit."""
    mean, scale, quat, opacity, sh = (
        first * float(power(last / first, part)) for first, last in (_MEAN, _SCALE, _QUAT, _OPACITY, _SH)
    )
    return StepSizes(mean, scale, quat, opacity, np.where(bands == 0, sh, _HIGHER_BANDS * sh))


def _over(picture: npt.NDArray[np.uint8], background: tuple[float, float, float]) -> npt.NDArray[np.uint8]:
    """Return a picture (H, W, 4) with its colours composited over the background, and its alpha."""
    if (picture[..., 3] == 255).all():
        return picture
    alpha = picture[..., 3:] / np.float32(255)
    out = picture.copy()
    out[..., :3] = np.rint(picture[..., :3] * alpha + (1 - alpha) * (255 * np.array(background, np.float32)))
    return out


def _visit(state: SplatFit, camera: Camera, target: TargetPicture, sizes: StepSizes) -> float:
    """Render a picture, and take a step. Returns the mean squared difference."""
    eye, places = eye_of(camera)
    rows, order = project(state.arrays, eye, state.start.antialiased)
    tiles = bent_tiles(places) if len(places) else even_tiles(camera.width, camera.height)
    counts = np.zeros(tiles.rows * tiles.columns, np.int64)
    count_entries(rows, tiles, counts)
    total = int(counts.sum())
    with memory.lent("the splats of a picture's tiles", _ENTRY_BYTES * total):
        starts = np.cumsum(counts) - counts
        ends, entries = starts.copy(), np.empty(total, np.int32)
        fill_entries(rows, tiles, 0, tiles.rows, ends, entries)
        sums: Singles = np.empty((total, SUMS), np.float32)
        errors = np.zeros(len(counts))
        lists = TileLists(0, len(counts), starts, ends, entries)
        blend_back(rows, lists, tiles.columns, places, target, sums, errors)
        found = Entries(sums, *entries_by_row(entries, len(rows)))
        take_steps(state.arrays, eye, state.start.antialiased, rows, order, found, state.moments, sizes)
    return float(errors.sum()) / (3 * camera.width * camera.height)
