"""What a packing library decides of a file's bytes, and what it does not.

Deflate and zstd may pack the same content in other ways from one version to the next: of such a file the bytes are
promised for the version that packed it, which stands beside it, and what unpacks from it for every version.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import platform
import re
import struct
from collections.abc import Callable
from importlib.metadata import version
from pathlib import PurePath
from typing import Any

import numpy as np
import PIL.Image
import PIL.ImageSequence
import zstandard
from PIL import features

from nerfbake import catalog
from nerfbake.catalog import uncompressed
from tests.support import svoq_reference

PICTURES = (".png", ".gif", ".html", ".glb")


def packed_by(path: str) -> dict[str, str]:
    """The versions of what decides how a file of this name is packed; {} where nothing does but nerfbake."""
    name = PurePath(path).name
    found = {}
    if name.endswith("_v3.spz"):
        return {"deflate": version("deflate")}
    if name.endswith((".zst", ".spz")):
        found["zstd"] = ".".join(map(str, zstandard.ZSTD_VERSION))
    if name.endswith(PICTURES):
        found["pillow"] = f"{PIL.__version__} with zlib {features.version('zlib')}"
    if name.endswith(("_zip.vdb", "_deflate.svoq")):
        found["deflate"] = version("deflate")
    if name.endswith("_zip.nvdb"):
        found["zlib-ng"] = version("zlib-ng")
    if name in ("atlas.json", "scene.glb"):
        found["nerfbake"] = version("nerfbake")
    if name == "atlas.json":  # it tells what it was made with
        found |= {"python": platform.python_version(), "numpy": np.__version__, "pillow": PIL.__version__}
    return found


def unpacked(path: str, data: bytes) -> Any:
    """What is the same whatever packed it; the bytes themselves where nothing does but nerfbake."""
    name = PurePath(path).name
    if name.endswith(".zst"):
        return unpacked(uncompressed(path), zstandard.ZstdDecompressor().decompressobj().decompress(data))
    if name == "atlas.json":
        return {key: value for key, value in json.loads(data).items() if key not in ("versions", "generator")}
    for ending, unpack in _UNPACK.items():
        if name.endswith(ending):
            return unpack(data)
    return data


def _pictures(data: bytes) -> Any:
    """All pictures of a PNG or GIF: size, mode and pixels; of a GIF how long each is shown, too."""
    with PIL.Image.open(io.BytesIO(data)) as file:
        frames = [(frame.convert("RGBA"), frame.info.get("duration")) for frame in PIL.ImageSequence.Iterator(file)]
        return file.mode if file.format == "PNG" else file.info.get("loop"), [
            (frame.size, np.asarray(frame).tobytes(), shown) for frame, shown in frames
        ]


def _streams(data: bytes) -> Any:
    """The header and the extensions of a .spz, and what its streams hold."""
    toc = int.from_bytes(data[16:20], "little")
    sizes = struct.unpack_from(f"<{2 * data[15]}Q", data, toc)
    found, at = [], toc + 16 * data[15]
    for packed in sizes[::2]:
        found.append(zstandard.ZstdDecompressor().decompressobj().decompress(data[at : at + packed]))
        at += packed
    return data[:toc], found, len(data) - at


def _depth(data: bytes) -> Any:
    with PIL.Image.open(io.BytesIO(data)) as picture:
        return np.asarray(picture).tolist()


def _page(data: bytes) -> Any:
    """The page's text, and its pictures."""
    pieces = re.split(rb"data:image/png;base64,([A-Za-z0-9+/=]+)", data)
    return pieces[::2], [_pictures(base64.b64decode(each)) for each in pieces[1::2]]


def _glb(data: bytes) -> Any:
    """The JSON but for where pieces of the body stand, and those pieces, pictures as pixels."""
    size = struct.unpack_from("<I", data, 12)[0]
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    document["asset"].pop("generator")
    document.pop("buffers")
    pieces = []
    for view in document.pop("bufferViews"):
        piece = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        pieces.append(_pictures(piece) if piece.startswith(b"\x89PNG") else piece)
    return document, pieces


def _plain(name: str) -> Callable[[bytes], Any]:
    """The same grids, not packed."""

    def unpack(data: bytes) -> Any:
        module = catalog.format_named(name, "Volume").load_module()
        return b"".join(module.encode(module.decode(memoryview(data)), codec="none"))

    return unpack


def _numbers(data: bytes) -> Any:
    """All whole numbers of a compressed octree."""
    return svoq_reference.read(data)


_UNPACK: dict[str, Callable[[bytes], Any]] = {
    ".depth.png": _depth,
    ".png": _pictures,
    ".gif": _pictures,
    ".html": _page,
    ".glb": _glb,
    "_v3.spz": gzip.decompress,
    ".spz": _streams,
    "_deflate.svoq": _numbers,
    "_zip.vdb": _plain("vdb"),
    "_zip.nvdb": _plain("nvdb"),
}
