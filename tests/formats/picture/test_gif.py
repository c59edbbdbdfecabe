from __future__ import annotations

import io
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image as Pillow
from PIL import ImageSequence

from nerfbake import Animation, Image, build_field, orbit_cameras, render_field
from nerfbake.errors import InvalidScene
from nerfbake.formats.picture import gif as animation_gif
from tests.support.scenes import n3tree

Colour = tuple[float, float, float]


def turning(background: Colour | None, frames: int = 5) -> Animation:
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=np.float32)
    tree.data[..., -1] *= 3
    field = build_field(tree)
    cameras = orbit_cameras(field, frames=frames, width=40, height=30).cameras
    return Animation(tuple(render_field(field, camera, background=background) for camera in cameras))


def seen(animation: Animation) -> tuple[list[npt.NDArray[np.uint8]], dict[Any, Any]]:
    """What a viewer draws: RGBA pictures, and what the file says of them."""
    with Pillow.open(io.BytesIO(b"".join(animation_gif.encode(animation)))) as picture:
        facts: dict[Any, Any] = {**picture.info, "size": picture.size, "format": picture.format}
        return [np.asarray(frame.convert("RGBA")) for frame in ImageSequence.Iterator(picture)], facts


def test_every_picture_is_shown_in_turn_forever() -> None:
    animation = turning((1.0, 1.0, 1.0))
    frames, facts = seen(animation)
    assert (len(frames), facts["size"], facts["format"]) == (5, (40, 30), "GIF")
    assert (facts["loop"], facts["duration"]) == (0, 80)
    for frame, image in zip(frames, animation.frames, strict=True):
        assert np.abs(frame[..., :3].astype(int) - image.pixels).mean() < 1.5


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (30 / 255, 61 / 255, 90 / 255)])
def test_the_background_keeps_its_colour_to_the_bit(background: Colour) -> None:
    animation = turning(background)
    colour = np.rint(255 * np.array(background))
    for frame, image in zip(seen(animation)[0], animation.frames, strict=True):
        empty = (image.pixels == colour).all(axis=2)
        assert empty.any()
        assert (frame[empty, :3] == colour).all()


def test_what_stands_still_does_not_flicker() -> None:
    animation = turning((1.0, 1.0, 1.0))
    pixels = [image.pixels for image in animation.frames]
    frames, _ = seen(animation)
    same = (pixels[0] == pixels[1]).all(axis=2)
    assert 0 < same.mean() < 1
    assert (frames[0][same] == frames[1][same]).all()


def test_no_background_is_transparent_and_leaves_no_trail() -> None:
    animation = turning(None)
    frames, facts = seen(animation)
    assert facts["transparency"] == 255
    for frame, image in zip(frames, animation.frames, strict=True):
        assert set(np.unique(frame[..., 3])) == {0, 255}
        assert ((frame[..., 3] == 255) == (image.pixels[..., 3] >= 128)).all()


def test_few_colours_stay_as_they_are() -> None:
    colours = np.random.default_rng(0).integers(0, 256, (2, 10, 12, 3)).astype(np.float32) / 255
    whole = np.ones((10, 12), np.float32)
    frames, _ = seen(Animation(tuple(Image(colour, whole, whole) for colour in colours)))
    assert [frame[..., :3].tolist() for frame in frames] == np.rint(255 * colours).astype(int).tolist()


def test_nothing_but_background_is_a_picture_too() -> None:
    clear = np.zeros((4, 4), np.float32)
    for background, alpha in (((1.0, 1.0, 1.0), 255), (None, 0)):
        nothing = Image(np.full((4, 4, 3), 1 if background else 0, np.float32), clear, clear, background)
        frames, _ = seen(Animation((nothing, nothing)))
        assert (frames[0][..., 3] == alpha).all()


def test_same_pictures_same_bytes() -> None:
    one, other = (b"".join(animation_gif.encode(turning((1.0, 1.0, 1.0)))) for _ in range(2))
    assert one == other


def test_pictures_that_do_not_go_together_are_refused() -> None:
    clear = np.zeros((9, 9), np.float32)
    small, large = turning(None).frames[0], Image(np.zeros((9, 9, 3), np.float32), clear, clear, None)
    with pytest.raises(InvalidScene, match="has no pictures; allowed: at least one"):
        Animation(())
    with pytest.raises(InvalidScene, match="picture 1 has 9x9 pixels; allowed: 40x30, like the first"):
        Animation((small, large))
    with pytest.raises(InvalidScene, match="picture 1 differs in transparency"):
        Animation((small, small.over((0.0, 0.0, 0.0))))
