"""Interfaces of the format modules, and the options of their encode().

A module of `formats/` that is listed in the catalog has the functions of FileFormat, or of FolderFormat if it stores
several files. A module for volumes also has those of VolumeFormat, and one that writes splats those of SplatFormat.
tests/rules/test_contract.py checks every module.

The signature of encode() defines the options of a format: keyword-only arguments, each with a type and a default.
    def encode(octree: SparseVoxelOctree, *, no_child: Literal[0, -1] = 0) -> Iterator[bytes | memoryview]:
Call require_options() before encode().
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from numbers import Real
from types import NoneType, UnionType
from typing import IO, Any, Literal, NamedTuple, Protocol, Union, get_args, get_origin, get_type_hints

from nerfbake.errors import Problem, UsageError, one_line

Piece = bytes | memoryview
HEAD = 512  # bytes that are enough to recognise most formats
HEAD_CAMERAS = 1 << 16  # the same for the cameras of other tools, whose text may start with long comments
# The extensions of each kind of picture; cameras of Canon, Nikon, Sony and Fujifilm write .HIF.
_HEIC = (".heic", ".HEIC", ".heif", ".HEIF", ".hif", ".HIF")
_ENDINGS = ((".png", ".PNG"), (".jpg", ".JPG", ".jpeg", ".JPEG"), _HEIC)
PICTURES = tuple(ending for kind in _ENDINGS for ending in kind)  # extensions that a capture may omit
_SHOWN = 60  # characters of an invalid value in a message


def picture_names(name: str) -> list[str]:
    """The possible file names of a picture with this name, the most likely one first.

    Captures omit the extension, or write it differently from the file: a.jpg for a.JPG, or for a.jpeg.
    """
    names = [name, *(name + ending for ending in PICTURES)]
    for kind in _ENDINGS:
        for ending in kind:
            if name.endswith(ending):
                names += [name.removesuffix(ending) + other for other in kind if other != ending]
    return names


def composed_name(name: str) -> str:
    """The composed form of a name, which equal names have in common: é is one character, or e and an accent.

    macOS decomposes the names of files, also in .zip files, where most programs write composed ones.
    """
    return unicodedata.normalize("NFC", name)


class StorableScene(Protocol):
    """Interface of every scene that can be stored in a file."""

    def problems(self) -> list[Problem]: ...

    def require_sound(self) -> None: ...


class FileFormat(Protocol):
    """A scene as the bytes of one file. The catalog names the scene type of each format."""

    def recognise(self, view: memoryview) -> bool:
        """Return whether these bytes are in this format; never raise. `view` is the whole, untrusted file.

        It is called if several formats share an extension, and for streams, so it must be fast. For most formats the
        first HEAD bytes are enough; npz_keys() lists the arrays of an .npz.
        """

    def encode(self, scene: Any, /, **options: Any) -> Iterable[Piece]:
        """Return the file in pieces. Raises InvalidScene if the format cannot represent the scene.

        Formats that are only read (`writable` in the catalog) have no encode().
        """

    def decode(self, view: memoryview, /, **beside: Any) -> Any:
        """Return the scene of a whole file. Raises InvalidFile, MemoryLimit.

        beside: `companion` if the catalog names one, `beside` if the catalog sets it.
        """


class FolderFormat(Protocol):
    """A scene as the files of one folder, by name."""

    FILES: re.Pattern[str]  # the names of all files that encode() may write; kinds that are only read have none

    def recognise(self, files: Mapping[str, memoryview]) -> bool:
        """Return whether the folder is of this kind, from its file names only; no file is read."""

    def encode(self, scene: Any, /, **options: Any) -> Iterable[tuple[str, Iterable[Piece]]]:
        """Return each file's name and its bytes in pieces. Kinds that are only read have no encode()."""

    def decode(self, files: Mapping[str, memoryview], /, **member: Any) -> Any:
        """Return the scene. `member`: the file given instead of the folder, if the catalog lists members."""


class HeadedFiles(Protocol):
    """The files of a folder by name, of which the beginnings can be read."""

    def __contains__(self, name: object) -> bool: ...

    def __getitem__(self, name: str) -> memoryview: ...

    def names(self, folder: str) -> list[str]:
        """Return the sorted names of the files in a subfolder ('' for this folder); [] if it does not exist."""

    def head(self, name: str, size: int) -> bytes:
        """Return the first `size` bytes of a file, or all of a shorter one; b'' if it does not exist."""


class CameraDialect(Protocol):
    """Cameras of another tool, which lie in the folder of a capture."""

    def recognise(self, name: str, head: bytes) -> bool:
        """Return whether a file is in this dialect; never raise.

        name: its path in the capture, with an ending of the catalog. head: its first bytes, untrusted: HEAD_CAMERAS, or
        as many as the Dialect says.
        """

    def decode(self, files: HeadedFiles, *, name: str) -> Any:
        """Return the cameras of the file `name` of a folder. Raises InvalidFile, InvalidScene, MemoryLimit."""


class WrittenDialect(CameraDialect, Protocol):
    """Cameras of another tool that are also written."""

    def encode(self, cameras: Any, /) -> Iterable[Piece]:
        """Return the file in pieces."""


class VolumeFormat(FileFormat, Protocol):
    """A format for volumes, which checks the grids before any work is done."""

    DEFAULT_GRIDS: tuple[str, ...]  # grids of an octree that are written by default
    FIELD_GRIDS: tuple[str, ...]  # grids of a fitted field: all of its values, where the format can store them
    KEEPS_HALVES: bool  # False: float16 values lose precision, so they are written on request only
    HALF_NOTE: str | None  # a warning if other programs misread float16 densities

    def require_grids(self, grids: tuple[str, ...], *, half: bool) -> None:
        """Raise UsageError if a file cannot store these grids (density, Cd, sh; or index) together."""


class SplatStore(Protocol):
    """What splats lose in a format, or in a kind of folder, that is written."""

    MOST_DEGREE: int  # of the spherical harmonics that it can store
    KEEPS_UP: bool  # True: the file says which axis is up, and splats with z up are stored unturned
    KEEPS_ORIGIN: bool  # False: positions of splats far from 0 are written relative to their origin
    # Optional: in_order(scene) returns the splats in the order in which encode() writes them.
    # Optional: readers_note(**options) returns which programs cannot read what encode() writes, or ''.


class SplatFormat(FileFormat, SplatStore, Protocol):
    """A format for Gaussian splats that is written."""


class ExaminedFormat(FileFormat, Protocol):
    """A format whose specification has rules that decode() does not need."""

    def examine(self, view: memoryview, /) -> list[Problem]:
        """Return the rules that a file breaks, for `nerfbake check`. Raises InvalidFile, MemoryLimit."""


class SpreadFormat(FileFormat, Protocol):
    """A format whose scenes may need further files beside their own: a mesh with its materials and textures."""

    def encode_files(self, scene: Any, stem: str, /, **options: Any) -> Iterable[tuple[str, Iterable[Piece]]]:
        """Return extension and bytes of each file, the scene's own file first.

        stem: the name of the file without its extension, which all of them share and by which they refer to each other.
        """


class StoredFormat(FileFormat, Protocol):
    """A format whose decode() needs a library that may not be installed, while encode() needs none."""

    def stored(self, scene: Any, /, **options: Any) -> Any:
        """Return the scene that decode() returns for the file of encode() with these options, without the library."""


class PackedFormat(FileFormat, Protocol):
    """A compressed format, for which the compressor searches the parameters that give a file size."""

    def coded_size(self, scene: Any, /, **options: Any) -> int:
        """Size in bytes of the file that encode() returns."""

    def describe_packing(self, view: memoryview, /) -> dict[str, Any]:
        """Return how a whole file is compressed, as values that JSON can represent, for people and scripts.

        Raises InvalidFile.
        """


class PageFormat(PackedFormat, Protocol):
    """A page for viewing. Its quality is measured on the scene that it contains."""

    def content_of(self, view: memoryview, /) -> Any:
        """Return the scene that a whole page contains. Raises InvalidFile, MemoryLimit."""

    def script_readable(self, view: memoryview, /) -> bytes:
        """Return the bytes that a page stores for the whole file of a compressed octree.

        They are the file's bytes unchanged if the page's script can read them.
        """


class CompressionFormat(Protocol):
    """An additional extension of any format."""

    def compress(self, pieces: Iterable[Piece], /) -> Iterable[Piece]: ...

    def decompress(self, view: memoryview, /) -> memoryview:
        """Raises InvalidFile, and MemoryLimit before the output exceeds the limit."""


class WrappingFormat(Protocol):
    """What other programs put around a file of any format. Results are bytes, name, and the files beside it."""

    def is_gzip(self, view: memoryview, /) -> bool:
        """Return whether these are the first bytes of a gzip stream."""

    def unwrap_gzip(self, view: memoryview, name: str, /) -> tuple[memoryview, str, Mapping[str, memoryview] | None]:
        """Raises InvalidFile, MemoryLimit."""

    def unwrap_zip(
        self, view: memoryview, endings: Sequence[tuple[str, ...]], /
    ) -> tuple[memoryview, str, Mapping[str, memoryview] | None] | None:
        """Return the only file with one of these endings, by groups of endings in order of preference, or None.

        Raises InvalidFile, MemoryLimit.
        """


class PhotographMetadata(Protocol):
    """What a photograph says of itself; None and False for what it does not say."""

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height as it is decoded."""

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Latitude and longitude in degrees and altitude in metres where it was taken."""

    @property
    def up(self) -> tuple[float, float, float] | None:
        """The direction that points up, in the camera's axes, by its sensors."""

    @property
    def all_round(self) -> bool:
        """Whether it shows all directions."""


class PhotographFormat(Protocol):
    """The pictures that a field is fitted to."""

    def decode_photograph(self, view: memoryview, size: tuple[int, int] | None = None, /) -> Any:
        """Return (H, W, 4) uint8, sRGB with straight alpha. Raises InvalidFile, MemoryLimit.

        size: (W, H) of the camera.
        """

    def check_photograph(self, view: memoryview, /) -> PhotographMetadata:
        """Return what a photograph says that can be decoded. Raises InvalidFile, MemoryLimit."""

    def read_metadata(self, view: memoryview, /) -> PhotographMetadata:
        """Return what a photograph says of itself; nothing if it cannot be opened.

        view: the first bytes of the file, of a HEIC all.
        """

    def is_heic(self, head: memoryview, /) -> bool:
        """Return whether the first bytes of a file are those of a HEIC."""

    def jpeg_of_heic(self, view: memoryview, /) -> bytes:
        """Return a HEIC as JPEG of the same size, with its EXIF data. Raises InvalidFile, MemoryLimit."""

    def encode_photograph(self, pixels: Any, /) -> bytes:
        """Return (H, W, 3) uint8, sRGB, as a JPEG."""

    def encode_thumbnail(self, view: memoryview, edge: int, /) -> bytes:
        """Return the picture as a PNG of at most `edge` pixels per side. Raises InvalidFile, MemoryLimit."""

    def encode_preview(self, view: memoryview, edge: int, size: tuple[int, int] | None = None, /) -> bytes:
        """Return the picture as a JPEG of at most `edge` pixels per side. Raises InvalidFile, MemoryLimit.

        size: (W, H) of the camera.
        """


class VideoFormat(Protocol):
    """The videos that photographs are taken from."""

    def container_of(self, head: bytes, /) -> str:
        """Return the container of a video by the first bytes of the file; '' if it is no video."""

    def opened_video(self, file: IO[bytes], /) -> AbstractContextManager[Any]:
        """Open a video, whose frames are decoded inside the block. Raises InvalidFile, MemoryLimit, UsageError."""


class CheckpointFormat(Protocol):
    """The state of an interrupted computation: facts, and arrays by name."""

    def encode_checkpoint(self, facts: Mapping[str, Any], arrays: Mapping[str, Any], /) -> Iterable[Piece]: ...

    def decode_checkpoint(self, view: memoryview, /) -> tuple[dict[str, Any], dict[str, Any]]:
        """Raises InvalidFile, MemoryLimit."""


class Option(NamedTuple):
    """An option of encode(). `kind` is its type, mostly a Literal of the accepted values."""

    kind: Any
    default: object

    def allows(self, value: object) -> bool:
        return _fits(value, self.kind)

    @property
    def allowed(self) -> str:
        """The accepted values, in words."""
        return ", ".join(_words(self.kind))

    @property
    def choices(self) -> tuple[str, ...]:
        """The accepted values as spelled on a command line, the default first."""
        words = _words(self.kind)
        return tuple(sorted(words, key=lambda word: word != str(self.default)))


def options_of(encode: Callable[..., object]) -> dict[str, Option]:
    """The options of this encode(), by name."""
    kinds = get_type_hints(encode)
    return {name: Option(kinds[name], default) for name, default in (encode.__kwdefaults__ or {}).items()}


def require_options(form: str, encode: Callable[..., object], given: Mapping[str, object]) -> None:
    """Raise UsageError, naming the format, if encode() does not take an option or its value."""
    options = options_of(encode)
    for name, value in given.items():
        if name not in options:
            allowed = ", ".join(f"{name} ({option.allowed})" for name, option in options.items())
            raise UsageError(f"{form} takes no option {name!r}; allowed: {allowed or 'none'}")
        if not options[name].allows(value):
            found = one_line(repr(value))[:_SHOWN]
            raise UsageError(f"option {name!r} of {form} is {found}; allowed: {options[name].allowed}")


def _fits(value: object, kind: Any) -> bool:
    origin = get_origin(kind)
    if origin is Literal:
        return isinstance(value, Hashable) and value in get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in get_args(kind))
    if kind is float:
        return isinstance(value, Real) and not isinstance(value, bool)
    return isinstance(value, origin or kind)


def _words(kind: Any) -> list[str]:
    origin = get_origin(kind)
    if origin is Literal:
        return [str(value) for value in get_args(kind)]
    if origin in (Union, UnionType):
        return [word for each in get_args(kind) for word in _words(each)]
    if kind is bool:
        return ["True", "False"]
    return [{float: "a number", NoneType: "None"}.get(kind, f"a {(origin or kind).__name__.lower()}")]
