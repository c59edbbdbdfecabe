"""What a format must offer: the shape of its module, and the options that its encode() takes.

A module of `formats/` that stands in the catalog has the functions of FileFormat, or of FolderFormat if it holds more
than one file; one of volumes has VolumeFormat's, too. tests/rules/test_contract.py holds every module to them.

encode()'s own signature says which options a format takes: keyword-only arguments, each with its type and its default.
    def encode(octree: SparseVoxelOctree, *, no_child: Literal[0, -1] = 0) -> Iterator[bytes | memoryview]:
Nobody hands on an option that was not compared with it by require_options().
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from numbers import Real
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Protocol, Union, get_args, get_origin, get_type_hints

from nerfbake.errors import Problem, UsageError, one_line

Piece = bytes | memoryview
HEAD = 512  # bytes that are enough to tell most formats by
_ENDINGS = ((".png", ".PNG"), (".jpg", ".JPG", ".jpeg", ".JPEG"))  # those of a line stand for the same kind of picture
PICTURES = tuple(ending for kind in _ENDINGS for ending in kind)  # endings that a capture may leave out of a name
_SHOWN = 60  # characters of a wrong value


def picture_names(name: str) -> list[str]:
    """The file names that a picture of this name may have, the first one first.

    Captures leave the ending out, or write it in another case than the file has: a.jpg for a.JPG, or for a.jpeg.
    """
    names = [name, *(name + ending for ending in PICTURES)]
    for kind in _ENDINGS:
        for ending in kind:
            if name.endswith(ending):
                names += [name.removesuffix(ending) + other for other in kind if other != ending]
    return names


class Scene(Protocol):
    """What is asked of every scene that a file can hold."""

    def problems(self) -> list[Problem]: ...

    def require_sound(self) -> None: ...


class FileFormat(Protocol):
    """A scene as the bytes of one file. Each format has its own type of scene, which the catalog's line names."""

    def recognise(self, view: memoryview) -> bool:
        """Whether these bytes are of this format; never raises. `view` is the whole file, from anybody.

        It is asked where several formats share an ending, and of streams, so it must cost next to nothing: the first
        HEAD bytes are enough for most, and npz_keys() tells what an .npz holds.
        """

    def encode(self, scene: Any, /, **options: Any) -> Iterable[Piece]:
        """The file in pieces. Raises InvalidScene for what the format cannot say. Formats that are read alone, as the
        catalog's line tells, have none."""

    def decode(self, view: memoryview, /, **beside: Any) -> Any:
        """The scene in a whole file. Raises InvalidFile, MemoryLimit.

        beside: `companion` where the catalog's line names one, `beside` where it says so.
        """


class FolderFormat(Protocol):
    """A scene as the files of one folder, by their names."""

    def recognise(self, files: Mapping[str, memoryview]) -> bool:
        """Whether the folder is of this kind: by the names of its files, without reading any."""

    def encode(self, scene: Any, /, **options: Any) -> Iterable[tuple[str, Iterable[Piece]]]:
        """Each file's name and its bytes in pieces. Kinds that are read alone have no encode()."""

    def decode(self, files: Mapping[str, memoryview], /, **member: Any) -> Any:
        """The scene. `member`: the file that was given for the folder, where the catalog's line has members."""


class VolumeFormat(FileFormat, Protocol):
    """A format of volumes, which says before any work is done what it can hold."""

    DEFAULT_GRIDS: tuple[str, ...]  # of an octree, where nobody says which
    KEEPS_HALVES: bool  # False: float16 values lose digits here, so that they are written only for those who ask
    HALF_NOTE: str | None  # what other programs make of a density in halves, if it is not what one expects

    def require_grids(self, grids: tuple[str, ...], *, half: bool) -> None:
        """Raises UsageError for grids of an octree (density, Cd, sh; or index) that a file cannot hold together."""


class PackedFormat(FileFormat, Protocol):
    """A format that packs what it writes so well that one looks for the scene whose file is as large as it may be."""

    def coded_size(self, scene: Any, /, **options: Any) -> int:
        """Bytes of the file that encode() gives."""

    def describe_packing(self, view: memoryview, /) -> dict[str, Any]:
        """What a whole file says of how it was packed, for people and scripts; JSON can hold it. Raises InvalidFile."""


class PageFormat(PackedFormat, Protocol):
    """A page that people look at, and that is judged by what it carries."""

    def content_of(self, view: memoryview, /) -> Any:
        """The scene that a whole page carries. Raises InvalidFile, MemoryLimit."""

    def carried(self, view: memoryview, /) -> bytes:
        """What a page carries of a packed octree's whole file: its bytes as they are, where its script reads them."""


class Compression(Protocol):
    """A further ending of any format."""

    def compress(self, pieces: Iterable[Piece], /) -> Iterable[Piece]: ...

    def decompress(self, view: memoryview, /) -> memoryview:
        """Raises InvalidFile; MemoryLimit before more is held than is allowed."""


class Photographs(Protocol):
    """The pictures that a field is fitted to."""

    def decode_photograph(self, view: memoryview, size: tuple[int, int] | None = None, /) -> Any:
        """(H, W, 4) uint8, sRGB and straight alpha. size: (W, H) of its camera. Raises InvalidFile, MemoryLimit."""

    def encode_thumbnail(self, view: memoryview, edge: int, /) -> bytes:
        """The picture as a PNG of at most so many pixels along each edge. Raises InvalidFile, MemoryLimit."""


class Checkpoints(Protocol):
    """Where a piece of work stands, for whoever goes on from there: facts, and arrays by name."""

    def encode_checkpoint(self, facts: Mapping[str, Any], arrays: Mapping[str, Any], /) -> Iterable[Piece]: ...

    def decode_checkpoint(self, view: memoryview, /) -> tuple[dict[str, Any], dict[str, Any]]:
        """Raises InvalidFile, MemoryLimit."""


class Option(NamedTuple):
    """An option of encode(). kind is its type, mostly a Literal of the values that are allowed."""

    kind: Any
    default: object

    def allows(self, value: object) -> bool:
        return _fits(value, self.kind)

    @property
    def allowed(self) -> str:
        """In words."""
        return ", ".join(_words(self.kind))

    @property
    def choices(self) -> tuple[str, ...]:
        """The values that it allows as a command line spells them, the default first."""
        words = _words(self.kind)
        return tuple(sorted(words, key=lambda word: word != str(self.default)))


def options_of(encode: Callable[..., object]) -> dict[str, Option]:
    """What this encode() takes, by name."""
    kinds = get_type_hints(encode)
    return {name: Option(kinds[name], default) for name, default in (encode.__kwdefaults__ or {}).items()}


def require_options(form: str, encode: Callable[..., object], given: Mapping[str, object]) -> None:
    """Raises UsageError, naming the format, for an option that its encode() does not take, or another value of one."""
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
