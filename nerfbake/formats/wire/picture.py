"""Decode and encode pictures with Pillow: textures, photographs and thumbnails.

Sizes are checked in the header before anything is inflated, and Pillow's errors become InvalidFile. Textures are PNG or
JPEG with 8-bit RGB. Photographs are PNG, JPEG or HEIC with 8 bits and straight alpha, whose colours become sRGB.

Data in pictures are lossless WebP.

COLMAP, instant-ngp and nerfstudio estimate poses on the pixels as stored, so the EXIF orientation is ignored. The poses
of some captures were estimated on pictures that had been rotated upright. There the width of the camera is the height
of the stored picture; only then is the picture rotated.

HEIC is what an iPhone stores (see heif.py). It stores its rotation in the picture, not in EXIF, and is always decoded
upright.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from numbers import Real
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from nerfbake import memory
from nerfbake.errors import InvalidFile, NerfbakeError, Problem
from nerfbake.formats.wire import heif, metadata
from nerfbake.formats.wire.colour_profile import into_srgb
from nerfbake.formats.wire.png import require_checksums
from nerfbake.kernels.soundness import MAX_EDGE

Coding = Literal["png", "jpeg", "webp"]
# Pictures of a textured chair (30.24 dB as PNG) have 30.23 and 30.20 dB, with a tenth of the bytes. Full resolution of
# a JPEG's colours gains 0.03 dB for a third more bytes, and quality 74 nothing for 17 % more.
_LOSSY: dict[str, dict[str, Any]] = {
    "jpeg": {"quality": 66, "subsampling": 0, "optimize": True, "progressive": True},
    "webp": {"quality": 85, "method": 6},
}
COMPRESSION = 3  # zlib's level: files 3 to 14 % larger than at 6, written in a third of the time
# What Pillow raises for damaged pictures: 13.0 raises AssertionError for a PNG with frames that it does not declare.
_BROKEN = (
    *(OSError, SyntaxError, ValueError, EOFError, IndexError, KeyError, TypeError, OverflowError),
    *(AssertionError, AttributeError, NotImplementedError, ZeroDivisionError, struct.error, zlib.error),
)
_PHOTOGRAPHS = ("PNG", "JPEG", "HEIF")  # as Pillow calls them
# ISO/IEC 23008-12, annex B: the brands of files that contain a picture in HEVC, or whose coding is not said.
_HEIC = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1")
_BOX = b"ftyp"  # ISO/IEC 14496-12, 4.3: the type of the first box, which a brand follows
_OTHERS = {  # first bytes of files that are not read: what such a file is
    b"BM": "a BMP",
    b"GIF8": "a GIF",
    b"II*\0": "a TIFF or a raw photograph",
    b"MM\0*": "a TIFF or a raw photograph",
    b"v/1\x01": "an OpenEXR",
    b"\xff\x0a": "a JPEG XL",
    b"\0\0\0\x0cJXL ": "a JPEG XL",
}
_BRANDS = {b"avif": "an AVIF", b"avis": "an AVIF", b"crx ": "a raw photograph"}  # others are those of videos


@contextmanager
def opened(view: memoryview, name: str, *kinds: str, bytes_per_pixel: int) -> Iterator[Image.Image]:
    """Open a picture; decode it inside the block. Raises InvalidFile, MemoryLimit.

    bytes_per_pixel: of memory that is needed in addition to the picture that Pillow decodes; 0 if only its header is
    read, or is there. Else a PNG's checksums are checked first, which takes 0.3 % of the time to decode it.
    """
    broken: tuple[type[Exception], ...] = _BROKEN
    if "HEIF" in kinds and is_heic(view):
        heif.require_heif(name)
        kinds, broken = ("HEIF",), heif.BROKEN
    else:
        kinds = tuple(kind for kind in kinds if kind != "HEIF")
    try:
        copies = 4 if bytes(view[:4]) == b"RIFF" else 1  # Pillow reads from a copy, of a WebP from several
        with warnings.catch_warnings(), memory.lent(name, copies * len(view)):
            warnings.simplefilter("ignore")  # large images are rejected below
            with Image.open(io.BytesIO(view), formats=kinds) as picture:
                width, height = picture.size
                if max(width, height) > MAX_EDGE:
                    raise InvalidFile(Problem(name, f"declares {width:,}x{height:,} pixels", f"{MAX_EDGE:,} an edge"))
                if bytes_per_pixel:
                    memory.require(name, (_decoded_size(picture) + bytes_per_pixel) * width * height)
                    if picture.format == "PNG":
                        require_checksums(view, name)
                yield picture
    except Image.DecompressionBombError:
        most = f"178 million, with {MAX_EDGE:,} an edge at most"
        raise InvalidFile(Problem(name, "declares more than 178 million pixels", most)) from None
    except broken as error:
        # Pillow's own message has the address of the buffer.
        reason = _content(bytes(view[:16])) if isinstance(error, UnidentifiedImageError) else str(error).strip()
        raise InvalidFile(Problem(name, f"cannot be read ({reason})", f"a whole {' or '.join(kinds)}")) from None


def _decoded_size(picture: Image.Image) -> int:
    """Bytes a pixel that Pillow needs at most to decode this picture, as measured."""
    kind = picture.format or ""
    if kind in _DECODED:
        return _DECODED[kind]
    return {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}.get(picture.mode, 4)


# A WebP: two canvases of libwebp, the picture as bytes, and Pillow's. A JPEG: Pillow's picture and, if it is
# progressive, all coefficients. An MPO is a JPEG with further pictures, such as a preview. A HEIC: libheif's planes and
# two copies.
_DECODED = {"WEBP": 16, "JPEG": 12, "MPO": 12, "HEIF": 12}
_BAND = 1 << 18  # pixels that are converted at once


def photograph_of(picture: Image.Image) -> npt.NDArray[np.uint8]:
    """Return the pixels in sRGB and alpha, (H, W, 4): see pixels_of()."""
    return pixels_of(picture, "RGBA", profile=picture.info.get("icc_profile"))


def pixels_of(picture: Image.Image, mode: str, *, profile: object = None) -> npt.NDArray[np.uint8]:
    """Return the pixels in this mode (RGB or RGBA), (H, W, channels), of 16 bits the upper 8.

    profile: an ICC profile, for RGBA; the colours become sRGB. glTF ignores the profiles of its textures.
    They are converted in bands, because Pillow copies all pixels twice for NumPy and once for each mode.
    """
    width, height = picture.size
    out = np.empty((height, width, len(mode)), np.uint8)
    rows = max(1, _BAND // width)
    for top in range(0, height, rows):
        band = picture.crop((0, top, width, min(height, top + rows)))
        band = eight_bits(band).convert(mode)
        into_srgb(band, profile)
        out[top : top + rows] = np.asarray(band)
    return out


def is_heic(head: memoryview) -> bool:
    """Return whether the first bytes of a file are those of a HEIC, whatever its name is."""
    return bytes(head[4:8]) == _BOX and bytes(head[8:12]) in _HEIC


def is_still(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a picture that has the boxes of a video."""
    return head[4:8] == _BOX and (head[8:12] in _HEIC or head[8:12] in _BRANDS)


def _content(head: bytes) -> str:
    """Say what a file is that Pillow cannot read, by its first bytes."""
    kind = next((kind for start, kind in _OTHERS.items() if head.startswith(start)), "")
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        kind = "a WebP"
    if head[4:8] == _BOX and head[8:12] not in _HEIC:
        kind = _BRANDS.get(head[8:12], "a video")
    return f"it is {kind}" if kind else "unknown content"


def is_photograph(head: memoryview) -> bool:
    """Return whether the first bytes of a file are those of a PNG, a JPEG or a HEIC."""
    return bytes(head[:4]) == b"\x89PNG" or bytes(head[:2]) == b"\xff\xd8" or is_heic(head)


def png_of(picture: Image.Image) -> bytes:
    """Encode a picture as PNG, without colour profile or date."""
    file = io.BytesIO()
    picture.save(file, "PNG", compress_level=COMPRESSION)
    return file.getvalue()


def size_of(head: bytes, name: str) -> tuple[int, int]:
    """Return width and height of a PNG or JPEG from its first bytes, or of a whole HEIC. Raises InvalidFile."""
    with opened(memoryview(head), name, *_PHOTOGRAPHS, bytes_per_pixel=0) as picture:
        return picture.size


def decode_texture(view: memoryview, name: str, *, any_mode: bool = False, webp: bool = False) -> npt.NDArray[np.uint8]:
    """Decode a texture to (H, W, 3) uint8, row 0 at the top. Raises InvalidFile unless it is 8-bit RGB, PNG or JPEG.

    any_mode  convert grey, palette and alpha to RGB instead, for pictures that are only displayed
    webp      also decode WebP

    The texels are counted until the surrounding memory.scope() ends. Raises MemoryLimit.
    """
    kinds = ("PNG", "JPEG", "WEBP") if webp else ("PNG", "JPEG")
    with opened(view, name, *kinds, bytes_per_pixel=3) as image:
        if not any_mode and image.mode != "RGB":
            raise InvalidFile(Problem(name, f"holds {image.mode} texels", "RGB, 8 bits a channel"))
        texels = pixels_of(image, "RGB")
    memory.hold(name, texels.nbytes)
    return texels


def decode_cut_out(view: memoryview, name: str) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None]:
    """Decode a texture that is displayed to (H, W, 3) uint8, and (H, W) bool, True where alpha is 1/2 or more.

    The second is None for a picture without alpha, or without such holes. PNG, JPEG or WebP. Raises InvalidFile,
    MemoryLimit.
    """
    with opened(view, name, "PNG", "JPEG", "WEBP", bytes_per_pixel=8) as image:
        if image.mode not in ("RGBA", "LA", "PA") and "transparency" not in image.info:
            return decode_texture(view, name, any_mode=True, webp=True), None
        texels = pixels_of(image, "RGBA")
    memory.hold(name, texels.nbytes)
    opaque = texels[..., 3] >= 128
    return np.ascontiguousarray(texels[..., :3]), None if opaque.all() else opaque


def decode_rgba(view: memoryview, name: str) -> npt.NDArray[np.uint8]:
    """Decode a picture of data to (H, W, 4) uint8. Raises InvalidFile unless it is an 8-bit RGBA PNG, MemoryLimit."""
    with opened(view, name, "PNG", bytes_per_pixel=4) as image:
        if image.mode != "RGBA":
            raise InvalidFile(Problem(name, f"holds {image.mode} texels", "RGBA, 8 bits a channel"))
        texels = pixels_of(image, "RGBA")
    memory.hold(name, texels.nbytes)
    return texels


def eight_bits(picture: Image.Image) -> Image.Image:
    """The upper 8 bits of a grey picture of 16 bits, of which Pillow's convert() clips all above 255; else itself."""
    if not picture.mode.startswith("I"):
        return picture
    return Image.fromarray((np.asarray(picture) >> 8).astype(np.uint8))


def decode_lossless_webp(view: memoryview, name: str, most: int) -> npt.NDArray[np.uint8]:
    """Decode a picture of data to (H, W, 4) uint8; alpha is 255 if the file has none.

    most: pixels that it may have, checked before Pillow opens the file, because libwebp allocates the picture then.
    They are counted until the surrounding memory.scope() ends. Raises InvalidFile, MemoryLimit.
    """
    width, height = _webp_size(bytes(view[:_WEBP_HEAD]))
    if not 0 < width * height <= most:
        found = f"declares {width:,}x{height:,} pixels" if width else "is not a lossless WebP"
        raise InvalidFile(Problem(name, found, f"a lossless WebP of at most {most:,} pixels"))
    with opened(view, name, "WEBP", bytes_per_pixel=4) as picture:
        if picture.size != (width, height) or getattr(picture, "n_frames", 1) > 1:
            raise InvalidFile(Problem(name, f"has a size of {picture.size}, or frames", f"{width:,}x{height:,}, once"))
        pixels = pixels_of(picture, "RGBA")
    memory.hold(name, pixels.nbytes)
    return pixels


def encode_lossless_webp(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Encode data (H, W, 4) as a lossless WebP that keeps the colours of transparent pixels."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


_WEBP_HEAD = 64  # bytes: of the file, VP8X, and the start of VP8L


def _webp_size(head: bytes) -> tuple[int, int]:
    """Width and height in the header of a lossless WebP; (0, 0) for other files."""
    if len(head) < 30 or head[:4] != b"RIFF" or head[8:12] != b"WEBP":
        return 0, 0
    if head[12:16] == b"VP8X":
        return 1 + int.from_bytes(head[24:27], "little"), 1 + int.from_bytes(head[27:30], "little")
    if head[12:16] != b"VP8L":
        return 0, 0
    bits = int.from_bytes(head[21:25], "little")
    return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)


def encode_texture(texels: npt.NDArray[np.uint8]) -> bytes:
    """Encode (H, W, 3) uint8, or (H, W, 4) with alpha, as a lossless PNG."""
    return png_of(Image.fromarray(texels))


def encode_picture(texels: npt.NDArray[np.uint8], coding: Coding) -> bytes:
    """Encode (H, W, 3) uint8 as PNG, or with losses as JPEG or WebP; (H, W, 4) with alpha as PNG or WebP."""
    if coding == "png" or (coding == "jpeg" and texels.shape[2] == 4):
        return encode_texture(texels)
    file = io.BytesIO()
    Image.fromarray(texels).save(file, coding, **_LOSSY[coding])
    return file.getvalue()


def encode_photograph(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Encode (H, W, 3) uint8 as a JPEG of high quality."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return file.getvalue()


_ORIENTATION = 0x0112  # EXIF 2.32, table 4
_UPRIGHT = {  # by orientation: the quarter turns
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")


def decode_photograph(view: memoryview, size: tuple[int, int] | None = None) -> npt.NDArray[np.uint8]:
    """Decode a photograph to (H, W, 4) uint8, row 0 at the top; alpha is 255 if the file has none.

    size: (W, H) of the camera. If the EXIF orientation is a quarter turn and only the rotated picture has the camera's
    shape, the picture is rotated upright. Raises InvalidFile, MemoryLimit.
    """
    with opened(view, "the picture", *_PHOTOGRAPHS, bytes_per_pixel=4) as picture:
        _require_mode(picture)
        turn = None if size is None else _turn(picture, size)
        if turn is None:
            return photograph_of(picture)
        memory.require("the picture", (_decoded_size(picture) + 8) * picture.width * picture.height)
        return photograph_of(picture.transpose(turn))


def check_photograph(view: memoryview) -> metadata.Metadata:
    """Return what a photograph says that decode_photograph() can read. Raises InvalidFile, MemoryLimit.

    A JPEG is decoded at an eighth of its resolution, in a tenth of the time: that reads all of its data, too.
    """
    with opened(view, "the picture", *_PHOTOGRAPHS, bytes_per_pixel=4) as picture:
        _require_mode(picture)
        found = metadata.metadata_of(picture)
        picture.draft(None, (1, 1))
        picture.load()
        return found


def read_metadata(view: memoryview) -> metadata.Metadata:
    """Return what a photograph says of itself; nothing if it cannot be opened.

    view: the first bytes of a PNG or a JPEG, or a whole HEIC.
    """
    with suppress(NerfbakeError), opened(view, "the picture", *_PHOTOGRAPHS, bytes_per_pixel=0) as picture:
        return metadata.metadata_of(picture)
    return metadata.Metadata()


def _require_mode(picture: Image.Image) -> None:
    if picture.mode not in _MODES:
        found = f"holds {picture.mode} pixels"
        raise InvalidFile(Problem("the picture", found, "grey, a palette or RGB, 8 bits a channel"))


def jpeg_of_heic(view: memoryview) -> bytes:
    """Encode a HEIC as JPEG of the same size. Of its EXIF data, only the focal length and the orientation are kept.

    A JPEG holds at most 64 kB of EXIF data, and what an iPhone adds about itself can be more. Raises InvalidFile,
    MemoryLimit.
    """
    with opened(view, "the picture", "HEIF", bytes_per_pixel=12) as picture:
        file = io.BytesIO()
        picture.convert("RGB").save(file, "JPEG", quality=_JPEG_QUALITY, exif=_lens_of(picture))
        return file.getvalue()


_JPEG_QUALITY = 95
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405  # EXIF 2.32, table 8


def _lens_of(picture: Image.Image) -> bytes:
    """The orientation and the focal lengths in a picture's EXIF data, as EXIF data; b"" if there are none."""
    try:
        found, kept = picture.getexif(), Image.Exif()
        kept.update(_numbers_of(found, _ORIENTATION))
        kept.get_ifd(metadata.EXIF).update(_numbers_of(found.get_ifd(metadata.EXIF), _FOCAL_LENGTH, _FOCAL_LENGTH_35MM))
        return kept.tobytes()
    except Exception:  # Pillow raises many types for damaged EXIF, which says nothing about the pixels
        return b""


def _numbers_of(tags: Any, *names: int) -> dict[int, Any]:
    return {name: tags[name] for name in names if isinstance(tags.get(name), Real)}


_PREVIEW_QUALITY = 80  # of JPEG: 20 to 40 kB at 480 x 360


def encode_preview(view: memoryview, edge: int, size: tuple[int, int] | None = None) -> bytes:
    """Scale a photograph down to at most `edge` pixels an edge, as JPEG on white. A smaller one keeps its size.

    size: (W, H) of the camera; the picture is rotated as in decode_photograph(). Raises InvalidFile, MemoryLimit.
    """
    with opened(view, "the picture", *_PHOTOGRAPHS, bytes_per_pixel=12) as picture:
        turn = None if size is None else _turn(picture, size)
        picture.draft("RGB", (2 * edge, 2 * edge))  # a JPEG is decoded at a lower resolution, at least this large
        small = _small(picture, edge)
        if turn is not None:
            small = small.transpose(turn)
        paper = Image.new("RGB", small.size, (255, 255, 255))
        paper.paste(small, mask=small.getchannel("A"))
        file = io.BytesIO()
        paper.save(file, "JPEG", quality=_PREVIEW_QUALITY)
        return file.getvalue()


def _small(picture: Image.Image, edge: int) -> Image.Image:
    """The picture with at most `edge` pixels an edge, in sRGB and alpha."""
    small = eight_bits(picture).convert("RGBA")
    small.thumbnail((edge, edge), Image.Resampling.BOX)
    into_srgb(small, picture.info.get("icc_profile"))
    return small


def _turn(picture: Image.Image, size: tuple[int, int]) -> Image.Transpose | None:
    """The quarter turn of a picture's EXIF orientation, if only the turned picture has its camera's shape, or None."""
    (width, height), (W, H) = picture.size, size
    if (width > height) == (W > H) or width == height or W == H:
        return None
    if picture.format == "PNG":
        picture.load()  # getexif() would do so, and errors of pixels must not pass as those of EXIF
    try:
        return _UPRIGHT.get(picture.getexif().get(_ORIENTATION, 1))
    except Exception:  # Pillow raises many types for damaged EXIF, which says nothing about the pixels
        return None


def encode_thumbnail(view: memoryview, edge: int, colours: int | None = None) -> bytes:
    """Scale a photograph or the first picture of a GIF down to at most `edge` pixels an edge, as PNG.

    A smaller picture keeps its size. colours: size of the palette; None: no palette. Raises InvalidFile, MemoryLimit.
    """
    with opened(view, "the picture", *_PHOTOGRAPHS, "GIF", bytes_per_pixel=12) as picture:
        small = _small(picture, edge)
        return png_of(small if colours is None else small.quantize(colours, Image.Quantize.FASTOCTREE))
