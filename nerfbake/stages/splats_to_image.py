"""Gaussian splats and camera -> picture."""

from __future__ import annotations

import numpy as np

from nerfbake import memory, progress
from nerfbake.kernels.arrays import Ints
from nerfbake.scene.camera import Camera, require_samples
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.splats import Splats

_ENTRIES = 1 << 23  # entries of tiles at a time
_PIXEL_BYTES = 40
_SPLAT_BYTES = 160


def render_splats(
    splats: Splats, camera: Camera, *, background: tuple[float, float, float] | None = WHITE, samples: int = 1
) -> Image:
    """Render the splats as seen by a camera. Source: docs/conventions.md, "How a picture of splats is made".

    Splats are projected to Gaussians in the picture, sorted by their depth along the optical axis, and blended front to
    back over a background.

    background  sRGB in 0..1; None: transparent
    samples     has no effect, so that a caller can treat all scenes alike. A Gaussian in the picture is already blurred
                by about a pixel. Finer pixels would blur it less: they would show thinner splats than every other
                program, and than the program that fitted them to pictures

    Through a lens, splats are blended at the place that each pixel has in the picture of a pinhole camera. Alpha is
    1 - transmittance. Depth is the mean distance of the splats' centres, weighted by their share of the pixel. The
    result does not depend on the number of threads. Raises InvalidScene for a lens that does not cover the picture or
    looks behind the camera, MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import Camera, Splats, render_splats
    >>> one, turn = np.ones((1, 3), np.float32), np.array([[1, 0, 0, 0]], np.float32)
    >>> red = np.array([[[1.77, -1.77, -1.77]]], np.float32)
    >>> splats = Splats(np.array([[0, 0, -5]], np.float32), one, turn, np.ones(1, np.float32), red)
    >>> image = render_splats(splats, Camera(9, 9, 9.0, np.eye(4)))
    >>> [round(float(part), 2) for part in (*image.colour[4, 4], image.depth[4, 4])]
    [1.0, 0.01, 0.01, 5.0]
    """
    require_samples(samples)
    splats.require_usable()
    camera.require_memory(_PIXEL_BYTES)
    memory.require(f"projecting {splats.n:,} splats", _SPLAT_BYTES * splats.n)
    from nerfbake.kernels.splat.blend import PicturePlanes, TileLists, blend
    from nerfbake.kernels.splat.project import SplatArrays, project
    from nerfbake.kernels.splat.tiles import bent_tiles, count_entries, even_tiles, fill_entries
    from nerfbake.stages._eye import eye_of

    H, W = camera.height, camera.width
    eye, places = eye_of(camera)
    tiles = bent_tiles(places) if len(places) else even_tiles(W, H)
    arrays = SplatArrays(splats.means, splats.scales, splats.quats, splats.opacity, splats.sh)
    rows, _ = project(arrays, eye, splats.antialiased)
    counts = np.zeros(tiles.rows * tiles.columns, np.int64)
    count_entries(rows, tiles, counts)
    behind = np.array(background or (0, 0, 0), np.float32)
    colour, alpha, depth = (np.empty(shape, np.float32) for shape in ((H, W, 3), (H, W), (H, W)))
    out = PicturePlanes(colour, alpha, depth, behind)
    for begin, end in progress.each(_bands(counts, tiles.columns)):
        some = slice(begin * tiles.columns, end * tiles.columns)
        total = int(counts[some].sum())
        with memory.lent("the splats of a picture's tiles", 4 * total):
            starts = np.zeros(len(counts), np.int64)
            starts[some] = np.cumsum(counts[some]) - counts[some]
            ends, entries = starts.copy(), np.empty(total, np.int32)
            fill_entries(rows, tiles, begin, end, ends, entries)
            blend(rows, TileLists(some.start, some.stop, starts, ends, entries), tiles.columns, eye, places, out)
    return Image(colour, alpha, depth, background)


def _bands(counts: Ints, columns: int) -> list[tuple[int, int]]:
    """Divide the rows of tiles into ranges of at most _ENTRIES entries, or of one row."""
    ends = np.cumsum(counts.reshape(-1, columns).sum(axis=1))
    bands, begin, before = [], 0, 0
    while begin < len(ends):
        end = max(int(np.searchsorted(ends, before + _ENTRIES, side="right")), begin + 1)
        bands.append((begin, end))
        begin, before = end, int(ends[end - 1])
    return bands
