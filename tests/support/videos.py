"""Videos as phones store them. PyAV encodes them; nothing of ours does."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt

BT601, BT709, BT2020 = 6, 1, 9  # ITU-T H.273: matrices, tables 2 to 4
SDR, HLG, PQ = 1, 18, 16  # transfer characteristics
_WEIGHTS = {BT601: (0.299, 0.114), BT709: (0.2126, 0.0722), BT2020: (0.2627, 0.0593)}  # of red and blue


def write_video(path: Path, frames: Sequence[npt.NDArray[np.floating]], **options: Any) -> Path:
    """Write what video_of() returns."""
    path.write_bytes(video_of(frames, path.suffix, **options))
    return path


def video_of(
    frames: Sequence[npt.NDArray[np.floating]],
    ending: str,
    *,
    matrix: int = BT709,
    curve: int = SDR,
    full: bool = False,
    turned: int = 0,
    rate: int = 25,
) -> bytes:
    """Encode frames, (H, W, 3) in 0 to 1 as they are stored, as YUV of full resolution and 10 bits, without loss.

    turned: quarter turns against the clock that a player has to make; of an .mp4. rate: frames a second.
    """

    def tag(owner: Any) -> None:
        owner.colorspace, owner.color_range = matrix, 2 if full else 1
        owner.color_trc, owner.color_primaries = curve, matrix

    file = io.BytesIO()
    with av.open(file, "w", format={".mkv": "matroska"}.get(ending, ending[1:])) as container:
        stream = container.add_stream("ffv1" if ending == ".mkv" else "libx264", rate=rate)
        stream.pix_fmt = "yuv444p10le"
        if ending != ".mkv":
            stream.options = {"qp": "0"}
        stream.height, stream.width = frames[0].shape[:2]
        tag(stream.codec_context)
        for number, pixels in enumerate(frames):
            frame = av.VideoFrame(stream.width, stream.height, "yuv444p10le")
            for plane, values in zip(frame.planes, _yuv(pixels, matrix, full), strict=True):
                rows = np.frombuffer(memoryview(plane), np.uint16).reshape(stream.height, -1)  # with a margin
                rows[:, : stream.width] = values
            frame.pts = number
            tag(frame)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return _turned(file.getvalue(), turned) if turned else file.getvalue()


def write_sound(path: Path) -> Path:
    """Write a file with sound alone."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), "fltp", "mono")
        sound.rate = 48000
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    return path


def _yuv(rgb: npt.NDArray[np.floating], matrix: int, full: bool) -> npt.NDArray[np.uint16]:
    """(3, H, W): H.273, equations 38 to 46, by their definition."""
    red, blue = _WEIGHTS[matrix]
    luma = red * rgb[..., 0] + (1 - red - blue) * rgb[..., 1] + blue * rgb[..., 2]
    chroma = [(rgb[..., 2] - luma) / (2 - 2 * blue), (rgb[..., 0] - luma) / (2 - 2 * red)]
    if full:
        return np.rint([1023 * luma, *(1023 * each + 512 for each in chroma)]).clip(0, 1023).astype(np.uint16)
    return np.rint([876 * luma + 64, *(896 * each + 512 for each in chroma)]).astype(np.uint16)


def _turned(data: bytes, turns: int) -> bytes:
    """Set the matrix of a track header (ISO/IEC 14496-12, 8.3.2)."""
    at = data.index(b"tkhd") + 44
    a, b = {1: (0, -1), 2: (-1, 0), 3: (0, 1)}[turns]
    one = 1 << 16
    return data[:at] + struct.pack(">9i", a * one, b * one, 0, -b * one, a * one, 0, 0, 0, 1 << 30) + data[at + 36 :]
