"""Moving pictures as GIF 89a: 255 colours for all pictures together and one for the background, forever again.

One palette and no dithering, so that nothing flickers from picture to picture: what keeps its colour keeps its index.
The background has the last index, exactly; where there is none, that index is transparent, and a pixel is that where
it is less than half covered. Pillow joins pictures that are equal into one that stays as long.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from nerfbake.kernels.picture.palette import ALL_COLOURS, UNKNOWN, nearest_colour
from nerfbake.scene.animation import Animation

Pixels = npt.NDArray[np.uint8]

_PAUSE = 80  # milliseconds a picture; GIF counts in hundredths of a second
_LAST = 255  # the background's index
_SAMPLE = 1 << 18  # pixels that a palette is made from
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
    """(256, 3): median cut over all pictures without their background, moved to the means of what they stand for.

    A colour counts as the square root of how often it is seen: else the largest thing takes all colours, and a small
    round one shows bands.
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
    """(m, 3) the colours of the pixels that show something."""
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
