"""load: the scene in a file, in a folder, or on stdin."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from nerfbake import memory
from nerfbake.catalog import (
    ADVICE,
    COMPRESSION_MAGIC,
    NOUNS,
    AnyFormat,
    FolderKind,
    compressed,
    folder_of_content,
    folder_of_member,
    folders_of,
    format_of_content,
    formats_of,
    load_compression,
    uncompressed,
)
from nerfbake.contract import Scene
from nerfbake.errors import InvalidFile, NerfbakeError, Problem
from nerfbake.io.sources import STREAM, Folder, blame, read_file, read_stdin, reading_name

Kind = TypeVar("Kind")


def load(source: str | Path, *kinds: type[Kind], sound: bool = True) -> Kind:
    """The scene in a file of any format, in a folder of any kind, or on stdin ('-').

    kinds: the scene types that are wanted; another one raises InvalidFile. sound=False gives a scene back even if its
    structure is broken, for scene.problems(). memory_limit() bounds what it may take. Raises NerfbakeError naming the
    file.

    >>> from nerfbake import N3Tree, load, sample_n3tree, save
    >>> size = save("small.npz", sample_n3tree(resolution=8))
    >>> load("small.npz", N3Tree).data_format
    'SH9'
    """
    return load_with_format(source, *kinds, sound=sound).scene


class Loaded(NamedTuple, Generic[Kind]):
    """scene; form: the file's format, or the folder's; size: bytes; of a packed file what it says of its packing, and
    its bytes."""

    scene: Kind
    form: AnyFormat
    size: int
    packing: dict[str, Any]
    data: memoryview | None = None


def load_with_format(source: str | Path, *kinds: type[Kind], sound: bool = True) -> Loaded[Kind]:
    """Like load(), with what the file says beside the scene."""
    name = reading_name(source)
    with blame(name):
        with memory.scope():
            member = folder_of_member(Path(source).name, Folder(Path(source).parent, {}))
            if str(source) != STREAM and Path(source).is_dir():
                found = _decode_folder(Path(source), kinds)
            elif member and Path(source).is_file():
                found = _decode_member(Path(source), member, kinds)
            else:
                found = _decode_file(source, kinds)
        memory.kept(found.scene)
        if sound:
            found.scene.require_sound()
    return found


def load_split(source: str | Path) -> tuple[str, str] | None:
    """Of a folder whose cameras are in two files, those to train with and those to judge by: their paths, else None."""
    path = Path(source)
    if not path.is_dir():
        return None
    with blame(str(source)):
        files = Folder(path, {})
        form = folder_of_content(files, "Cameras")
        split = getattr(form.load_module(), "split", lambda files: None)(files)
    return None if split is None else (str(path / split[0]), str(path / split[1]))


def check(source: str | Path) -> list[Problem]:
    """Everything that is wrong with a file: what keeps it from being read, else its structure, else its values."""
    try:
        scene: Scene = load(source, sound=False)
    except NerfbakeError as error:
        return [error.problem]
    return scene.problems()


def load_page_content(source: str | Path) -> Any:
    """What a page to look around in carries, for whoever judges it; load() reads no pages, which are for people.

    Raises NerfbakeError naming the file.
    """
    with blame(str(source)), memory.scope():
        view = read_file(Path(source))
        if view[:4] == COMPRESSION_MAGIC:
            view = load_compression().decompress(view)
        content = formats_of("Page")[0].load_page_module().content_of(view)
    return memory.kept(content)


def _decode_file(source: str | Path, kinds: tuple[type[Kind], ...]) -> Loaded[Any]:
    stream = str(source) == STREAM
    view = read_stdin() if stream else read_file(Path(source))
    path, size = "" if stream else str(source), len(view)
    packed = view[:4] == COMPRESSION_MAGIC
    if packed:
        view = load_compression().decompress(view)
        path = uncompressed(path)
    if not len(view):
        raise InvalidFile("is empty; allowed: a file that nerfbake reads")
    form = format_of_content(path, view)
    if packed and form.packed:
        raise InvalidFile(f"is a {form.suffix} in zstd's frames, though it is packed already; allowed: {form.suffix}")
    extra: dict[str, object] = {}
    if form.companion and path:
        extra["companion"] = Path(path[: -len(form.suffix)] + form.companion).exists()
    if form.beside and path:
        extra["beside"] = Folder(Path(path).parent, {})
    _require_kind(form, kinds)
    scene = form.load_module().decode(view, **extra)
    if form.packed:
        return Loaded(scene, form, size, form.load_packed_module().describe_packing(view), view)
    return Loaded(scene, compressed(form) if packed else form, size, {})


def _decode_folder(path: Path, kinds: tuple[type[Kind], ...]) -> Loaded[Any]:
    files = Folder(path, {})
    form = folder_of_content(files, *(kind.__name__ for kind in kinds))
    _require_kind(form, kinds)
    size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    return Loaded(form.load_module().decode(files), form, size, {})


def _decode_member(path: Path, form: FolderKind, kinds: tuple[type[Kind], ...]) -> Loaded[Any]:
    """A file that means nothing without those beside it: its folder, read from this file."""
    _require_kind(form, kinds)
    return Loaded(form.load_module().decode(Folder(path.parent, {}), member=path.name), form, path.stat().st_size, {})


def _require_kind(form: AnyFormat, kinds: tuple[type[Kind], ...]) -> None:
    if kinds and form.scene not in [kind.__name__ for kind in kinds]:
        allowed = " or ".join(NOUNS[kind.__name__] for kind in kinds)
        advice = f" ({ADVICE[form.scene]})" if form.scene in ADVICE else ""
        raise InvalidFile(f"holds {NOUNS[form.scene]}{advice}; allowed: {allowed}")


def load_folder(source: str | Path, kind: type[Kind], *, more: Mapping[str, memoryview] | None = None) -> Kind:
    """The scene of this type in a folder, and in `more` files as if they stood there.

    Raises NerfbakeError naming the folder and the file in it.
    """
    with blame(str(source)):
        path = Path(source)
        if not path.is_dir():
            found = "is no folder" if path.exists() else "is not there"
            raise InvalidFile(f"{found}; allowed: a folder, {folders_of(kind.__name__)[0].title}")
        return decode_files(Folder(path, more or {}), kind)


def decode_files(files: Mapping[str, memoryview], kind: type[Kind]) -> Kind:
    """The scene of this type in files of these names, wherever they come from."""
    modules = [form.load_module() for form in folders_of(kind.__name__)]
    module = next((module for module in modules if module.recognise(files)), modules[0])
    with memory.scope():
        scene: Kind = module.decode(files)
    return memory.kept(scene)


def load_files(paths: Mapping[str, str | Path]) -> dict[str, memoryview]:
    """Files from anywhere under the names that a folder would have for them."""
    files = {}
    for name, path in paths.items():
        with blame(str(path)):
            files[name] = read_file(Path(path))
    return files


def load_lines(source: str | Path) -> str:
    """The text of a file or of stdin, whose bytes that are no UTF-8 are what the system makes of them in names.

    Raises InvalidFile naming the file, MemoryLimit.
    """
    with blame(reading_name(source)), memory.scope():
        return os.fsdecode(bytes(read_stdin() if str(source) == STREAM else read_file(Path(source))))
