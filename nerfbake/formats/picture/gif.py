"""Write animations as looping GIF 89a with one palette: 255 colours for all frames, and one for the background.

The palette is shared and there is no dithering, so that nothing flickers: an unchanged colour keeps its index. The last
index is exactly the background. Without a background, that index is transparent, and a pixel is transparent if it is
less than half covered. Pillow merges equal consecutive frames into one with their total duration.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from nerfbake.kernels.picture.drawing import ALL_COLOURS, UNKNOWN, nearest_colour
from nerfbake.scene.image import Animation

Pixels = npt.NDArray[np.uint8]

_PAUSE = 80  # milliseconds a frame; GIF counts in hundredths of a second
_LAST = 255  # the background's index
_SAMPLE = 1 << 18  # pixels from which the palette is computed
_RESET = 2  # GIF's disposal method: back to transparency before the next picture


def encode(animation: Animation) -> Iterator[bytes]:
    palette = _palette(animation)
    known = np.full(ALL_COLOURS, UNKNOWN, np.int16)
    pictures = [_indexed(frame.pixels, palette, known) for frame in animation.frames]
    how: dict[str, Any] = {"transparency": _LAST, "disposal": _RESET} if animation.transparent else {}
    file = io.BytesIO()
    pictures[0].save(
        file, "GIF", save_all=True, append_images=pictures[1:], duration=_PAUSE, loop=0, optimize=False, **how
    )
    yield file.getvalue()


def _palette(animation: Animation) -> Pixels:
    """Compute the palette (256, 3): median cut over all frames without the background, then one step of k-means.

    A colour is weighted by the square root of its frequency. Otherwise the largest object would get most colours, and
    small round objects would show bands.
    """
    background = np.rint(255 * np.array(animation.frames[0].background or (0, 0, 0))).astype(np.uint8)
    step = max(1, len(animation.frames) * animation.size[0] * animation.size[1] // _SAMPLE)
    colours = np.concatenate([_covered(frame.pixels, background)[::step] for frame in animation.frames])
    if not len(colours):
        colours = background[None]
    different, times = np.unique(colours, axis=0, return_counts=True)
    weighed = np.repeat(different, np.ceil(np.sqrt(times)).astype(int), axis=0)
    cut = Pillow.fromarray(weighed[None]).quantize(_LAST, Pillow.Quantize.MEDIANCUT, kmeans=1)
    found = np.array(cut.getpalette(), np.uint8).reshape(-1, 3)[:_LAST]
    return np.concatenate([found, np.repeat(background[None], _LAST + 1 - len(found), axis=0)])


def _covered(pixels: Pixels, background: Pixels) -> Pixels:
    """The colours (m, 3) of the pixels that are not background."""
    shown = pixels[..., 3] >= 128 if pixels.shape[2] == 4 else (pixels != background).any(axis=2)
    return pixels[shown][:, :3]


def _indexed(pixels: Pixels, palette: Pixels, known: npt.NDArray[np.int16]) -> Pillow.Image:
    opaque = pixels.shape[2] == 3
    indices = nearest_colour(pixels[..., :3].reshape(-1, 3), palette[: _LAST + opaque], known).reshape(pixels.shape[:2])
    if not opaque:
        indices[pixels[..., 3] < 128] = _LAST
    picture = Pillow.fromarray(indices)
    picture.putpalette(palette.tobytes())
    return picture
