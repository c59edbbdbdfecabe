"""Write a scene as a file, as a folder, or to stdout."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from nerfbake.catalog import (
    COMPRESSED,
    Format,
    compressed,
    folder_to_write,
    format_named,
    format_of_path,
    formats_of,
    is_ending,
    load_compression,
    uncompressed,
)
from nerfbake.errors import OutputError, UsageError
from nerfbake.io.own_folders import FolderContents
from nerfbake.io.sources import STREAM, blame
from nerfbake.io.streams import write_stdout
from nerfbake.io.targets import keep_pending, replacing_file, replacing_files, replacing_folder


def save(
    target: str | Path,
    scene: object,
    *,
    to: str | None = None,
    force: bool = False,
    parents: bool = False,
    **options: object,
) -> int:
    """Write a scene in the format of the target's extension, or in `to` (required for '-'); return its size in bytes.

    parents: create missing folders. options: those of the format. Raises UsageError if the format does not take an
    option. Raises OutputError if the target exists and `force` is not set, or if it cannot be written; an existing
    target is then unchanged.

    >>> from nerfbake import build_octree, load, sample_n3tree, save
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> save("small.svo.pb", octree, profile="report") == save("small.svo.npz", octree)
    False
    >>> print(load("small.svo.pb"))
    SH9 octree of 8x8x8, 205 nodes, float32, full
    """
    if isinstance(scene, str | Path):
        raise TypeError(f"the path comes first: save({str(scene)!r}, scene), not save(scene, {str(scene)!r})")
    with saving(target, scene, to=to, force=force, parents=parents, **options) as saved:
        return saved.size


class PendingFile(NamedTuple):
    """An output that is on disk, but not yet at the target's path.

    path   path of the file or folder that replaces the target when the block ends
    sizes  bytes of each file by name; the name of a single file is '', of one that is written beside it its extension
    """

    path: str
    sizes: dict[str, int]

    @property
    def size(self) -> int:
        """Total bytes of all files."""
        return sum(self.sizes.values())


@contextmanager
def saving(
    target: str | Path,
    scene: object,
    *,
    to: str | None = None,
    force: bool = False,
    parents: bool = False,
    **options: object,
) -> Iterator[PendingFile]:
    """save() as a context manager: the block can check the output before it replaces the target.

    If the block raises BudgetMissed, the output becomes TARGET.rejected and the target is unchanged. After any other
    error the output is deleted. While the block runs, nothing here keeps the scene.
    """
    form = format_for(target, type(scene).__name__, to=to)
    form.require_options(options)
    if form.spread and str(target) != STREAM and not form.suffix.endswith(COMPRESSED):
        stem = _stem_of(target, form, to)
        files = list(form.load_spread_module().encode_files(scene, stem, **options))
        if len(files) > 1:
            with _saving_files(Path(target), stem, files, force=force, parents=parents) as saved:
                yield saved
            return
    pieces = form.load_module().encode(scene, **options)
    del scene
    if form.suffix.endswith(COMPRESSED):
        pieces = load_compression().compress(pieces)
    if str(target) == STREAM:
        yield PendingFile(STREAM, {"": write_stdout(pieces)})
        return
    with blame(str(target), OutputError):
        if parents:
            Path(target).parent.mkdir(parents=True, exist_ok=True)
        with replacing_file(Path(target), force=force) as path:
            with open(path, "wb") as file:
                size = _write_all(file, pieces)
            del pieces
            yield PendingFile(str(path), {"": size})


def paths_beside(target: str | Path, form: Format, *, to: str | None = None) -> list[str]:
    """Return the paths of the files that may be written beside a file of this format."""
    if str(target) == STREAM or form.suffix.endswith(COMPRESSED):
        return []
    stem = _stem_of(target, form, to)
    return [str(Path(target).with_name(stem + ending)) for ending in form.spread]


def _stem_of(target: str | Path, form: Format, to: str | None) -> str:
    """The name of a file without its extension, which files beside it share."""
    return Path(target).name[: -len(form.suffix)] if to is None else Path(target).stem


@contextmanager
def _saving_files(
    target: Path, stem: str, files: Sequence[tuple[str, Iterable[bytes | memoryview]]], *, force: bool, parents: bool
) -> Iterator[PendingFile]:
    """saving() of a scene whose first file refers to the others, which stand beside it."""
    names = [target.name, *(stem + ending for ending, _ in files[1:])]
    with blame(str(target), OutputError):
        if parents:
            target.parent.mkdir(parents=True, exist_ok=True)
        with replacing_files(target, names, force=force) as folder:
            sizes = _write_files(folder, [(name, pieces) for name, (_, pieces) in zip(names, files, strict=True)])
            endings = ["", *(ending for ending, _ in files[1:])]
            yield PendingFile(str(folder / target.name), dict(zip(endings, sizes.values(), strict=True)))


def keep_partial(written: PendingFile, target: str | Path) -> str:
    """Rename an output that is written to TARGET.partial; return that path. Raises OutputError.

    Files that stand beside each other become a folder. An earlier TARGET.partial is replaced.
    """
    partial = Path(f"{target}.partial")
    with blame(str(partial), OutputError):
        keep_pending(Path(written.path), partial, folder=len(written.sizes) > 1)
    return str(partial)


def save_folder(target: str | Path, scene: object, *, force: bool = False, **options: object) -> dict[str, int]:
    """Write a scene as a folder; return the size in bytes of each file.

    options: those of the kind of folder. Raises UsageError if it does not take an option. The folder appears completely
    or not at all. With `force` it replaces an existing folder of the same kind that contains nothing else.
    """
    with saving_folder(target, scene, force=force, **options) as saved:
        return saved.sizes


@contextmanager
def saving_folder(
    target: str | Path, scene: object, *, force: bool = False, **options: object
) -> Iterator[PendingFile]:
    """save_folder() as a context manager: the block can check the folder first, see saving()."""
    kind = folder_to_write(type(scene).__name__)
    kind.require_options(options)
    files = kind.load_module().encode(scene, **options)
    contents = FolderContents.of(kind)
    with blame(str(target), OutputError), replacing_folder(Path(target), contents, force=force) as folder:
        yield PendingFile(str(folder), _write_files(folder, files))


def save_files(
    target: str | Path,
    files: Iterable[tuple[str, Iterable[bytes | memoryview]]],
    contents: FolderContents,
    *,
    force: bool = False,
) -> dict[str, int]:
    """Write files as a folder, like save_folder(); return their sizes. A name may contain a subfolder.

    contents: of a folder that these files may replace.
    """
    with blame(str(target), OutputError), replacing_folder(Path(target), contents, force=force) as folder:
        return _write_files(folder, files)


def format_for(target: str | Path, scene: str, *, to: str | None = None) -> Format:
    """Return the format to write; its suffix ends with .zst if the output is to be compressed.

    Raises UsageError if neither `to` nor the target's extension names a format for this scene type.
    """
    wanted = str(target) if to is None else to
    form = _format_for(uncompressed(str(target)), scene, None if to is None else uncompressed(to))
    if form.packed and wanted.lower().endswith(COMPRESSED):
        raise UsageError(
            f"{wanted!r} would be no smaller: a {form.suffix} is compressed already; allowed: {form.suffix}"
        )
    return compressed(form) if wanted.lower().endswith(COMPRESSED) else form


def _format_for(target: str, scene: str, to: str | None) -> Format:
    if to is not None:
        form = format_named(to, scene)
        if is_ending(target, scene) and (other := format_of_path(target, scene)) != form:
            found = f"the extension of {target!r} is that of {other.name}, but `to` is {form.name}"
            raise UsageError(f"{found}; allowed: one of them")
        return form
    if target == STREAM and len(only := formats_of(scene)) == 1:
        return only[0]
    if target == STREAM:
        raise UsageError("stdout has no file extension; allowed: `to=FORMAT`")
    return format_of_path(target, scene)


def _write_files(folder: Path, files: Iterable[tuple[str, Iterable[bytes | memoryview]]]) -> dict[str, int]:
    sizes = {}
    for name, pieces in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with open(folder / name, "xb") as file:
            sizes[name] = _write_all(file, pieces)
    return sizes


def _write_all(file: IO[bytes], pieces: Iterable[bytes | memoryview]) -> int:
    size = 0
    for piece in pieces:
        file.write(piece)
        size += len(piece)
    file.flush()
    return size
