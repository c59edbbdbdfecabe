"""Decode the frames of a video with PyAV, an optional library that contains FFmpeg.

FFmpeg opens a hundred containers, and some of them, such as playlists, name other files and addresses. Only those of
phones and cameras are opened here, by the first bytes of the file, and FFmpeg is told which one it is.

Frames are sRGB, 8 bits a channel, upright. Phones record HDR as HLG with the primaries of BT.2020: such frames are
decoded to linear light, in which reference white is 1, and brighter light is cut off. Sources: ITU-R BT.2100-2, tables
4 and 5; ITU-R BT.2408-7, table 1 (reference white is a signal of 75 % in HLG, and of 58 % in PQ); ITU-R BT.2087-0.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.picture import is_still
from nerfbake.installation import require_installed
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import rotate
from nerfbake.kernels.maths.elementary import exp, power
from nerfbake.kernels.picture.metrics import from_linear
from nerfbake.kernels.soundness import MAX_EDGE

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

_HELD = 24  # frames that FFmpeg may hold: 16 that others refer to, and those that its threads decode
_MARGIN = 256  # pixels that FFmpeg may add to an edge in memory
_HLG, _PQ, _BT2020 = 18, 16, 9  # ITU-T H.273, tables 2 and 3
_WHITE = {_HLG: 0.75, _PQ: 0.58}  # the signal of reference white
# BT.2087-0, annex 2: linear BT.2020 to linear BT.709, whose primaries are those of sRGB.
_TO_709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]
)


def container_of(head: bytes) -> str:
    """Return FFmpeg's name of a video's container, by the first bytes of the file; '' if it is no video."""
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free") and not is_still(head):
        return "mov"  # QuickTime, MP4
    if head.startswith(b"\x1aE\xdf\xa3"):
        return "matroska"  # also WebM
    return "avi" if head[:4] == b"RIFF" and head[8:12] == b"AVI " else ""


class DecodedFrame:
    """A decoded frame. Its pixels are converted on demand."""

    def __init__(self, frame: VideoFrame) -> None:
        self._frame = frame

    def grey(self, edge: int) -> npt.NDArray[np.uint8]:
        """Return its luma, (h, w), at most `edge` pixels per side, as stored: not upright, and of HDR not converted."""
        scale = min(1.0, edge / max(self._frame.width, self._frame.height))
        width, height = (max(1, round(scale * size)) for size in (self._frame.width, self._frame.height))
        return self._converted("gray", width, height)

    def pixels(self) -> npt.NDArray[np.uint8]:
        """Return (H, W, 3) sRGB, row 0 at the top, upright."""
        curve = int(self._frame.color_trc)
        if curve in _WHITE:
            light, wide = _light_of(curve), int(self._frame.color_primaries) == _BT2020
            pixels = np.stack([_standard(light[row], wide) for row in self._converted("rgb48le")])
        else:
            pixels = self._converted("rgb24")
        return np.ascontiguousarray(np.rot90(pixels, round(self._frame.rotation / 90)))

    def _converted(self, to: str, width: int | None = None, height: int | None = None) -> npt.NDArray[Any]:
        from av.video.reformatter import Interpolation

        how = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.BITEXACT  # the same on every processor
        pixels: npt.NDArray[Any] = self._frame.reformat(width, height, to, interpolation=how, threads=1).to_ndarray()
        return pixels


class Video:
    """A video that is open.

    size     width and height of its frames, as stored
    frames   their number
    seconds  how long it is
    """

    def __init__(self, container: Any, frames: int, seconds: float) -> None:
        self._container, self.frames, self.seconds = container, frames, seconds
        codec = container.streams.video[0].codec_context
        self.size = (codec.width, codec.height)

    def __iter__(self) -> Iterator[DecodedFrame]:
        """Decode the frames in the order in which they are shown. Raises InvalidFile."""
        with _broken():
            for frame in self._container.decode(video=0):
                if (frame.width, frame.height) != self.size:
                    found = f"has {frame.width}x{frame.height} pixels"
                    raise InvalidFile(Problem("a frame", found, "{}x{}, as the first one".format(*self.size)))
                yield DecodedFrame(frame)


@contextmanager
def opened_video(file: IO[bytes]) -> Iterator[Video]:
    """Open a video; its frames are decoded inside the block. Raises InvalidFile, MemoryLimit, UsageError."""
    kind = container_of(file.read(16))
    if not kind:
        raise InvalidFile("is no video that is read; allowed: .mp4, .mov, .mkv, .webm or .avi")
    require_installed("av", "reading a video")
    import av

    av.logging.set_level(None)
    with _broken():
        frames, seconds = _length(file, kind)
        file.seek(0)
        container = av.open(file, format=kind)
    with container:
        stream = _stream(container)
        width, height = stream.codec_context.width, stream.codec_context.height
        if not 0 < max(width, height) <= MAX_EDGE or not frames:
            found = f"has {frames:,} frames of {width:,}x{height:,} pixels"
            raise InvalidFile(Problem("the video", found, f"1 frame or more of at most {MAX_EDGE:,} pixels an edge"))
        memory.require("the video", width * height * (_HELD * 3 + 16))
        stream.thread_type = "AUTO"
        stream.codec_context.options = {"max_pixels": str((width + _MARGIN) * (height + _MARGIN))}  # of later frames
        yield Video(container, frames, seconds)


def _length(file: IO[bytes], kind: str) -> tuple[int, float]:
    """Return the number of frames and the seconds, by the packets: headers need not tell it."""
    import av

    file.seek(0)
    container: Any = av.open(file, format=kind)
    with container:
        stream = _stream(container)
        times = [packet.pts for packet in container.demux(stream) if packet.pts is not None and not packet.is_discard]
        span = max(times) - min(times) if times else 0
        return len(times), float(span * stream.time_base)


def _stream(container: Any) -> Any:
    if not container.streams.video:
        raise InvalidFile(Problem("the video", "has no pictures", "1 stream of pictures or more"))
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise InvalidFile(Problem("the video", "has an unknown coding", "one that FFmpeg decodes"))
    return stream


@contextmanager
def _broken() -> Iterator[None]:
    """Turn FFmpeg's errors into InvalidFile."""
    from av.error import FFmpegError

    try:
        yield
    except (FFmpegError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InvalidFile(Problem("the video", f"cannot be decoded ({reason})", "a whole video")) from None


def _standard(light: Floats, wide: bool) -> npt.NDArray[np.uint8]:
    """Convert (..., 3) linear light to sRGB. wide: its primaries are those of BT.2020."""
    linear = rotate(light, _TO_709) if wide else light
    return _encoded()[np.rint(65535 * np.clip(linear, 0, 1)).astype(np.uint16)]


@lru_cache(1)
def _encoded() -> npt.NDArray[np.uint8]:
    """(65536,) sRGB of linear light in steps of 1 / 65535, of which darkness has 20 for each step of sRGB."""
    return np.rint(255 * from_linear(np.arange(65536) / 65535)).astype(np.uint8)


@lru_cache(1)
def _light_of(curve: int) -> Floats:
    """(65536,) light of each signal of HDR, 1 for reference white."""
    signal = np.arange(65536) / 65535
    light = _light_of_hlg(signal) if curve == _HLG else _light_of_pq(signal)
    return np.asarray(light / light[round(65535 * _WHITE[curve])])


def _light_of_hlg(signal: Floats) -> Floats:
    """The inverse of HLG's OETF: the light of the scene, 1 at the peak."""
    return np.where(signal <= 0.5, signal**2 / 3, (exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)


def _light_of_pq(signal: Floats) -> Floats:
    """PQ's EOTF: the light of the display, 1 at 10,000 cd/m2."""
    root = power(np.maximum(signal, 1e-9), 32 / 2523)
    light = np.maximum(root - 107 / 128, 1e-30) / (2413 / 128 - 2392 / 128 * root)
    return power(light, 8192 / 1305)
