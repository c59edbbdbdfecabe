"""load and save: the only place that opens files.

A file is mapped, not read; '-' is stdin or stdout. What is written appears whole or not at all: a temporary file in
the same folder is renamed over the target once everything is in it, with the permissions any new file gets. Any format
may be compressed, said by a further ending (.zst), or seen by the first bytes.
"""

from __future__ import annotations

import mmap
import os
import shutil
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

from nerfbake.catalog import (
    COMPRESSED,
    COMPRESSION_MAGIC,
    Format,
    folder_of_content,
    folders_of,
    format_named,
    format_of_content,
    format_of_path,
    formats_of,
    load_compression,
)
from nerfbake.errors import (
    BudgetMissed,
    InvalidFile,
    MemoryLimit,
    NerfbakeError,
    OutputError,
    PipeClosed,
    Problem,
    UsageError,
)

MAX_MEMORY = 4 << 30
STREAM = "-"
_CHUNK = 1 << 20

Scene = TypeVar("Scene")


def load(source: str | Path, *kinds: type[Scene], max_memory: int = MAX_MEMORY, sound: bool = True) -> Scene:
    """The scene in a file of any format, in a folder of any kind, or on stdin ('-').

    kinds: the scene types that are wanted; another one raises InvalidFile. max_memory bounds, in bytes, what a file's
    headers may declare, before anything is allocated. sound=False gives a scene back even if its structure is
    broken, for scene.problems(). Raises NerfbakeError naming the file.
    """
    return load_with_format(source, *kinds, max_memory=max_memory, sound=sound)[0]


def load_with_format(
    source: str | Path, *kinds: type[Scene], max_memory: int = MAX_MEMORY, sound: bool = True
) -> tuple[Scene, Format, int]:
    """Like load(), with the file's format and its size in bytes, or those of a folder."""
    name = reading_name(source)
    with blame(name):
        if name != "stdin" and Path(name).is_dir():
            return _load_any_folder(Path(name), kinds, max_memory)
        view = _read_all(sys.stdin.buffer, max_memory) if name == "stdin" else _map(Path(source), max_memory)
        if not len(view):
            raise InvalidFile("is empty; allowed: a file that nerfbake reads")
        path, size = "" if name == "stdin" else name, len(view)
        packed = view[:4] == COMPRESSION_MAGIC
        if packed:
            view = load_compression().decompress(view, max_memory=max_memory)
            path = uncompressed(path)
        form = format_of_content(path, bytes(view[:512]))
        extra: dict[str, Any] = {}
        if form.companion and path:
            extra["companion"] = Path(path[: -len(form.suffix)] + form.companion).exists()
        scene = form.load_module().decode(view, max_memory=max_memory, **extra)
        _require_kind(form, kinds)
        if sound:
            scene.require_sound()
        return scene, _compressed(form) if packed else form, size


def _load_any_folder(path: Path, kinds: tuple[type[Scene], ...], max_memory: int) -> tuple[Scene, Format, int]:
    files = _Folder(path, max_memory, {})
    form = folder_of_content(files)
    _require_kind(form, kinds)
    size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    return form.load_module().decode(files, max_memory=max_memory), form, size


def _require_kind(form: Format, kinds: tuple[type[Scene], ...]) -> None:
    if kinds and form.scene not in [kind.__name__ for kind in kinds]:
        allowed = " or ".join(_article(kind.__name__) for kind in kinds)
        raise InvalidFile(f"holds {_article(form.scene)}; allowed: {allowed}")


def check(source: str | Path, *, max_memory: int = MAX_MEMORY) -> list[Problem]:
    """Everything that is wrong with a file: what keeps it from being read, else its structure, else its values."""
    try:
        scene: Any = load(source, max_memory=max_memory, sound=False)
    except NerfbakeError as error:
        return [error.problem]
    problems: list[Problem] = scene.problems()
    return problems


def save(
    target: str | Path, scene: Any, *, to: str | None = None, force: bool = False, parents: bool = False, **options: Any
) -> int:
    """Writes a scene in the format that the target's ending names (or `to`, always for '-'); gives its size in bytes.

    parents: makes the folders that lead there; options go to the format's encode(). Raises OutputError if the target
    exists and `force` is not given, or if it cannot be written; what stood there before is then untouched.
    """
    form = format_for(target, type(scene).__name__, to=to)
    pieces = form.load_module().encode(scene, **options)
    if form.suffix.endswith(COMPRESSED):
        pieces = load_compression().compress(pieces)
    if str(target) == STREAM:
        if sys.stdout.isatty():
            raise UsageError("stdout is a terminal; allowed: a pipe or a file")
        try:
            return _write_all(sys.stdout.buffer, pieces)
        except BrokenPipeError:
            raise PipeClosed from None
    with blame(str(target), OutputError):
        if parents:
            Path(target).parent.mkdir(parents=True, exist_ok=True)
    with blame(str(target), OutputError), replacing(Path(target), force=force) as file:
        return _write_all(file, pieces)


def load_folder(
    source: str | Path,
    kind: type[Scene],
    *,
    more: Mapping[str, memoryview] | None = None,
    max_memory: int = MAX_MEMORY,
) -> Scene:
    """The scene of this type in a folder, and in `more` files as if they stood there.

    Raises NerfbakeError naming the folder and the file in it.
    """
    with blame(str(source)):
        path = Path(source)
        if not path.is_dir():
            found = "is no folder" if path.exists() else "is not there"
            raise InvalidFile(f"{found}; allowed: a folder, {folders_of(kind.__name__)[0].title}")
        return decode_files(_Folder(path, max_memory, more or {}), kind, max_memory=max_memory)


def decode_files(files: Mapping[str, memoryview], kind: type[Scene], *, max_memory: int = MAX_MEMORY) -> Scene:
    """The scene of this type in files of these names, wherever they come from."""
    modules = [form.load_module() for form in folders_of(kind.__name__)]
    module = next((module for module in modules if module.recognise(files)), modules[0])
    scene: Scene = module.decode(files, max_memory=max_memory)
    return scene


def load_files(paths: Mapping[str, str | Path], *, max_memory: int = MAX_MEMORY) -> dict[str, memoryview]:
    """Files from anywhere under the names that a folder would have for them."""
    files = {}
    for name, path in paths.items():
        with blame(str(path)):
            files[name] = _map(Path(path), max_memory)
    return files


def save_folder(target: str | Path, scene: Any, *, force: bool = False) -> dict[str, int]:
    """Writes a scene as a folder; gives the size in bytes of each file.

    The folder appears whole or not at all: its files are written to a temporary one beside it, which is renamed. With
    `force` a folder that stands there is moved aside first and removed at the end, whatever is in it.
    """
    require_no_folder(target, force=force)
    path = Path(os.path.realpath(target))
    temporary, aside = (path.with_name(f".{path.name[:200]}.{os.getpid()}.{what}") for what in ("tmp", "old"))
    sizes = {}
    with blame(str(target), OutputError):
        try:
            temporary.mkdir()
            for name, pieces in folders_of(type(scene).__name__)[0].load_module().encode(scene):
                with open(temporary / name, "xb") as file:
                    sizes[name] = _write_all(file, pieces)
            if path.exists():
                path.replace(aside)
            temporary.replace(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            if aside.exists() and not path.exists():
                aside.replace(path)
            shutil.rmtree(aside, ignore_errors=True)
    return sizes


def require_no_folder(target: str | Path, *, force: bool) -> None:
    """Raises OutputError if the target is there and may not be replaced: asked before the work, not after it."""
    path = Path(target)
    if os.path.lexists(path) and not path.is_dir():
        raise OutputError("is no folder; allowed: a new folder", source=str(target))
    if path.is_dir() and any(path.iterdir()) and not force:
        raise OutputError("exists already; allowed: a new or empty folder, or --force", source=str(target))


class _Folder(Mapping[str, memoryview]):
    """A folder's files by name, each mapped when it is asked for, and more that are in its place."""

    def __init__(self, path: Path, max_memory: int, more: Mapping[str, memoryview]) -> None:
        self._path, self._max_memory, self._more = path, max_memory, more

    def __getitem__(self, name: str) -> memoryview:
        if name in self._more:
            return self._more[name]
        path = self._path / name
        if not path.is_file():
            raise KeyError(name)
        with blame(str(path)):
            return _map(path, self._max_memory)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({path.name for path in self._path.iterdir()} | set(self._more)))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def format_for(target: str | Path, scene: str, *, to: str | None = None) -> Format:
    """The format to write; its suffix ends with .zst where it is to be compressed.

    Raises UsageError where neither `to` nor the target's ending names one for this scene type.
    """
    wanted = str(target) if to is None else to
    form = _format_for(uncompressed(str(target)), scene, None if to is None else uncompressed(to))
    return _compressed(form) if wanted.lower().endswith(COMPRESSED) else form


def _format_for(target: str, scene: str, to: str | None) -> Format:
    if to is not None:
        return format_named(to, scene)
    if target == STREAM and len(only := formats_of(scene)) == 1:
        return only[0]
    if target == STREAM:
        raise UsageError("stdout has no ending that names a format; allowed: --to FORMAT")
    return format_of_path(target, scene)


def uncompressed(name: str) -> str:
    """A path, or a format's name, without the ending of a compressed file."""
    return name[: -len(COMPRESSED)] if name.lower().endswith(COMPRESSED) else name


def _compressed(form: Format) -> Format:
    return form._replace(name=form.name + COMPRESSED, suffix=form.suffix + COMPRESSED)


def require_absent(target: str | Path, *, force: bool) -> None:
    """Raises OutputError if the target is there and may not be replaced: asked before the work, not after it."""
    if str(target) != STREAM and not force and os.path.lexists(target) and _is_regular(Path(target)):
        raise OutputError("exists already; allowed: a new file, or --force", source=str(target))


@contextmanager
def replacing(target: Path, *, force: bool) -> Iterator[IO[bytes]]:
    """A file that takes the target's place when the block ends well, and vanishes when it does not."""
    require_absent(target, force=force)
    target = Path(os.path.realpath(target))
    if target.exists() and not _is_regular(target):
        # A pipe or a device is written to; renaming something over /dev/null would be a disaster.
        with open(target, "wb") as file:
            yield file
        return
    temporary = target.with_name(f".{target.name[:200]}.{os.getpid()}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def rejected_unless_good(path: str | Path) -> Iterator[None]:
    """Moves a file or folder to PATH.rejected if the block finds that it costs too much."""
    try:
        yield
    except BudgetMissed:
        rejected = Path(f"{Path(path)}.rejected")
        if Path(path).is_dir() and rejected.is_dir():
            shutil.rmtree(rejected)  # of the last time; a file would be replaced, too
        Path(path).replace(rejected)
        raise


def _is_regular(path: Path) -> bool:
    return not path.exists() or stat.S_ISREG(path.stat().st_mode)


@contextmanager
def blame(name: str, error_type: type[NerfbakeError] = InvalidFile) -> Iterator[None]:
    """Names the file in every error that leaves the block, and turns the system's errors into ours."""
    try:
        yield
    except NerfbakeError as error:
        if error.source is None:
            error.source = name
        raise
    except OSError as error:
        raise error_type(f"{error.strerror or error}", source=name) from error


def _map(path: Path, max_memory: int) -> memoryview:
    with open(path, "rb") as file:
        status = os.fstat(file.fileno())
        if stat.S_ISREG(status.st_mode):
            if not status.st_size:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        return _read_all(file, max_memory)


def _read_all(file: IO[bytes], max_memory: int) -> memoryview:
    data = bytearray()
    while chunk := file.read(_CHUNK):
        data += chunk
        if len(data) > max_memory:
            raise MemoryLimit("the stream", len(data), max_memory)
    return memoryview(data).toreadonly()


def reading_name(source: str | Path) -> str:
    """What words and errors call a source."""
    return "stdin" if str(source) == STREAM else str(source)


def _write_all(file: IO[bytes], pieces: Iterable[bytes | memoryview]) -> int:
    size = 0
    for piece in pieces:
        file.write(piece)
        size += len(piece)
    file.flush()
    return size


def _article(noun: str) -> str:
    return f"an {noun}" if noun[0] in "AEIOUN" else f"a {noun}"
