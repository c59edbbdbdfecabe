"""Read the scene in a file, in a folder, or on stdin, and the photographs of a capture."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from nerfbake import memory
from nerfbake.catalog import (
    ADVICE,
    COMPRESSION_MAGIC,
    DIALECTS,
    FIELDS,
    MAKERS,
    NOUNS,
    AnyFormat,
    Dialect,
    FolderKind,
    compressed,
    dialect_of,
    dialects_in,
    folder_of_content,
    folder_of_member,
    folders_of,
    format_of_content,
    formats_of,
    lacks,
    load_compression,
    load_photographs,
    uncompressed,
    unread_file,
)
from nerfbake.contract import HEAD, HEAD_CAMERAS, PICTURES, PhotographMetadata, StorableScene, picture_names
from nerfbake.errors import InvalidFile, NerfbakeError, OutputError, Problem, without
from nerfbake.io.sources import (
    STREAM,
    Folder,
    StoredNames,
    blame,
    broken_link,
    read_file,
    read_stdin,
    reading_name,
    require_some,
)
from nerfbake.io.wrappings import unwrapped

Kind = TypeVar("Kind")
_HEAD_METADATA = 1 << 18  # bytes of a JPEG in which EXIF data and XMP are looked for: each has up to 64 kB


def load(source: str | Path, *kinds: type[Kind], sound: bool = True) -> Kind:
    """Return the scene in a file of any format, in a folder of any kind, or on stdin ('-').

    kinds: the accepted scene types; InvalidFile is raised for any other. sound=False also returns a scene whose
    structure is invalid, so that scene.problems() can describe it. memory_limit() limits its memory. Raises
    NerfbakeError naming the file.

    >>> from nerfbake import N3Tree, load, sample_n3tree, save
    >>> size = save("small.npz", sample_n3tree(resolution=8))
    >>> load("small.npz", N3Tree).data_format
    'SH9'
    """
    return load_with_format(source, *kinds, sound=sound).scene


class Loaded(NamedTuple, Generic[Kind]):
    """A scene with facts about its file.

    scene    the scene
    form     the format of the file, or the kind of the folder
    size     bytes of the file or folder; of a file that is read with others of its folder, of all these
    packing  for a compressed format, its description of the compression, else empty
    data     for a compressed format, the bytes of the file, else None
    """

    scene: Kind
    form: AnyFormat | Dialect
    size: int
    packing: dict[str, Any]
    data: memoryview | None = None


def load_with_format(
    source: str | Path, *kinds: type[Kind], sound: bool = True, examined: list[Problem] | None = None
) -> Loaded[Kind]:
    """Like load(), but also return facts about the file. examined: the rules of its format that it breaks are added."""
    name = reading_name(source)
    with blame(name):
        with memory.scope():
            member = folder_of_member(Path(source).name, Folder(Path(source).parent, {}))
            if str(source) != STREAM and Path(source).is_dir():
                found = _decode_folder(Path(source), kinds)
            elif member and Path(source).is_file():
                found = _decode_member(Path(source), member, kinds)
            elif (tool := _tool_of(source, kinds)) is not None:
                found = _decode_tool(Path(source), tool, kinds)
            else:
                found = _decode_file(source, kinds, examined)
        memory.kept(found.scene)
        if sound:
            found.scene.require_sound()
    return found


def is_folder(path: str | Path) -> bool:
    """Return whether there is a folder at this path. Raises InvalidFile, for example for a name that is too long."""
    with blame(str(path)):
        return Path(path).is_dir()


def load_split(source: str | Path) -> tuple[str, str] | None:
    """Return the paths of the training cameras and the test cameras of a folder that keeps them in two files.

    None for any other folder or file.
    """
    path = Path(source)
    if not is_folder(path):
        return None
    with blame(str(source)):
        files = Folder(path, {})
        form, _ = _folder_form(files, "Cameras")
        split = getattr(form.load_module(), "split", lambda files: None)(files)
    return None if split is None else (str(path / split[0]), str(path / split[1]))


def check(source: str | Path) -> list[Problem]:
    """Return all problems of a file.

    These are the rules of its format that it breaks, else the error that prevents reading the file, else the problems
    of its structure, else those of its values.
    """
    examined: list[Problem] = []
    try:
        found: Loaded[StorableScene] = load_with_format(source, sound=False, examined=examined)
    except NerfbakeError as error:
        return examined or [error.problem]
    return examined or found.scene.problems()


def load_page_content(source: str | Path) -> Any:
    """Return the scene that a page for viewing contains, to measure its quality. load() does not read pages.

    Raises NerfbakeError naming the file.
    """
    with blame(str(source)), memory.scope():
        view = read_file(Path(source))
        if view[:4] == COMPRESSION_MAGIC:
            view = load_compression().decompress(view)
        content = formats_of("Page")[0].load_page_module().content_of(view)
    return memory.kept(content)


def _decode_file(
    source: str | Path, kinds: tuple[type[Kind], ...], examined: list[Problem] | None = None
) -> Loaded[Any]:
    stream = str(source) == STREAM
    view = read_stdin() if stream else read_file(Path(source))
    path, size = "" if stream else str(source), len(view)
    packed = view[:4] == COMPRESSION_MAGIC
    if packed:
        view = load_compression().decompress(view)
        path = uncompressed(path)
    require_some(view)
    view, path, archive = unwrapped(view, path)
    form = format_of_content(path, view, *(kind.__name__ for kind in kinds))
    if packed and form.packed:
        raise InvalidFile(f"is a {form.suffix} in zstd frames, but it is compressed already; allowed: {form.suffix}")
    extra: dict[str, object] = {}
    if form.companion and path and archive is None:
        extra["companion"] = Path(path[: -len(form.suffix)] + form.companion).exists()
    if form.beside and path:
        extra["beside"] = Folder(Path(path).parent, {}) if archive is None else archive
    _require_kind(form, kinds)
    if examined is not None and (module := form.load_examined_module()) is not None:
        with memory.scope():
            examined += module.examine(view)
    scene = form.load_module().decode(view, **extra)
    if form.packed:
        return Loaded(scene, form, size, form.load_packed_module().describe_packing(view), view)
    return Loaded(scene, compressed(form) if packed else form, size, {})


def _decode_folder(path: Path, kinds: tuple[type[Kind], ...]) -> Loaded[Any]:
    files = Folder(path, {})
    form, name = _folder_form(files, *(kind.__name__ for kind in kinds))
    _require_kind(form, kinds)
    size = _folder_size(path)
    if isinstance(form, Dialect):
        return Loaded(form.load_module().decode(files, name=name), form, size, {})
    return Loaded(form.load_module().decode(files), form, size, {})


def _folder_size(path: Path) -> int:
    """Return the bytes of all files in a folder and its subfolders. Links to folders are not followed."""
    files = (Path(folder, name) for folder, _, names in os.walk(path) for name in names)
    return sum(file.stat().st_size for file in files if file.is_file())


def _folder_form(files: Folder, *wanted: str) -> tuple[FolderKind | Dialect, str]:
    """Return folder_of_content(), else the tool of a file of cameras in the folder, with the name of that file.

    The error names a broken link that is in place of a file.
    """
    try:
        return folder_of_content(files, *wanted), ""
    except InvalidFile:
        if not wanted or "Cameras" in wanted:
            found = next(((form, name) for form, name in dialects_in(files) if not lacks(form, files)), None)
            if found is not None:
                return found
        if files.broken is not None:
            told = f"is a symbolic link to {files.broken.readlink()}, which does not exist"
            raise InvalidFile(f"{told}; allowed: a file", source=str(files.broken)) from None
        if (names := files.names("")) and all(name.lower().endswith(PICTURES) for name in names):
            advice = "`nerfbake fit` takes them, and `nerfbake poses` finds their cameras"
            raise InvalidFile(f"holds pictures alone ({advice}); allowed: a scene or cameras") from None
        raise


def _tool_of(source: str | Path, kinds: tuple[type[Any], ...]) -> Dialect | None:
    """Return the tool whose cameras a file holds; None for any other file, for a stream and for a pipe.

    A scene that also has meshes is one of cameras only if nothing else is wanted.
    """
    path = Path(source)
    if str(source) == STREAM or not path.is_file():
        return None
    name = path.name.lower()
    most = max((form.head for form in DIALECTS if name.endswith(form.endings)), default=0)
    with path.open("rb") as file:
        head = file.read(min(most, max(HEAD_CAMERAS, memory.left() // 2)))
    form = dialect_of(path.name, head)
    if form is None or not form.is_shared:
        return form
    wanted = {kind.__name__ for kind in kinds}
    alone = wanted == {"Cameras"} or (not wanted - {"Cameras"} and b'"mesh' not in head)
    return form if alone else None


def _decode_tool(path: Path, form: Dialect, kinds: tuple[type[Kind], ...]) -> Loaded[Any]:
    """Read cameras of another tool from their file. The capture is the folder above, if it is in a subfolder of it."""
    _require_kind(form, kinds)
    root, name = capture_of(path, form)
    with without(name):
        scene = form.load_module().decode(Folder(root, {}), name=name)
    return Loaded(scene, form, path.stat().st_size, {})


def capture_of(path: Path, form: Dialect) -> tuple[Path, str]:
    """Return the folder of the capture that a file of cameras belongs to, and the path of the file in it."""
    path = path.absolute()
    for place in sorted(form.places, key=len, reverse=True):
        parts = Path(place).parts
        if parts and path.parent.parts[-len(parts) :] == parts:
            return path.parents[len(parts)], f"{place}/{path.name}"
    return path.parent, path.name


def unread_cameras(source: str | Path, read: str) -> list[tuple[str, str]]:
    """Return the files of cameras in a folder that are not read, each with its tool and the reason.

    read: the file that is read, '' if there is none.
    """
    path = Path(source)
    if not is_folder(path):
        return []
    with blame(str(source)):
        files = Folder(path, {})
        known = [(name, form, lacks(form, files)) for form, name in dialects_in(files)]
        others = [(name, unread_file(name)) for name in files.names("")]
    because = f"{read} is read instead" if read else "their poses are found instead"
    found = [
        (f"{name} of {form.title}", f"its poses need {missing} beside it" if missing else because)
        for name, form, missing in known
        if not read or not _covers(read, name)
    ]
    return found + [(f"{name} of {tool[0]}", f"nerfbake reads {tool[1]}") for name, tool in others if tool]


def _covers(read: str, name: str) -> bool:
    """Whether a file is one of those that were read: it is named, or all files with its ending in its folder are."""
    folder, star, ending = read.partition("*")
    return name == read or bool(star and name.startswith(folder) and name.endswith(ending))


def _decode_member(path: Path, form: FolderKind, kinds: tuple[type[Kind], ...]) -> Loaded[Any]:
    """Read a folder from one of its member files, which cannot be read alone."""
    _require_kind(form, kinds)
    files = Folder(path.parent, {})
    with without(path.name):
        scene = form.load_module().decode(files, member=path.name)
    return Loaded(scene, form, files.bytes_read, {})


def _require_kind(form: AnyFormat | Dialect, kinds: tuple[type[Kind], ...]) -> None:
    wanted = [kind.__name__ for kind in kinds]
    if wanted and form.scene not in wanted:
        advice = _advice(form.scene, wanted)
        told = f"holds {NOUNS[form.scene]}{advice and f' ({advice})'}"
        raise InvalidFile(f"{told}; allowed: {' or '.join(map(NOUNS.__getitem__, wanted))}")


def _advice(found: str, wanted: Sequence[str]) -> str:
    """Return which commands make what is wanted of a scene, else which take the scene; '' if none is known."""
    makers = [(MAKERS[each], NOUNS[each]) for each in wanted if each in MAKERS and found in FIELDS]
    if not makers:
        return ADVICE.get(found, "")
    return ", ".join(f"`nerfbake {command}` makes {noun} of it" for command, noun in makers)


def load_folder(source: str | Path, kind: type[Kind], *, more: Mapping[str, memoryview] | None = None) -> Kind:
    """Return the scene of this type in a folder. `more` files count as files of the folder.

    Raises NerfbakeError naming the folder and the file in it.
    """
    with blame(str(source)):
        path = Path(source)
        if not path.is_dir():
            found = broken_link(path) or ("is not a folder" if path.exists() else "does not exist")
            raise InvalidFile(f"{found}; allowed: a folder, {folders_of(kind.__name__)[0].title}")
        return decode_files(Folder(path, more or {}), kind)


def decode_files(files: Mapping[str, memoryview], kind: type[Kind]) -> Kind:
    """Return the scene of this type from files with these names, wherever their bytes come from."""
    modules = [form.load_module() for form in folders_of(kind.__name__)]
    module = next((module for module in modules if module.recognise(files)), modules[0])
    with memory.scope():
        scene: Kind = module.decode(files)
    return memory.kept(scene)


def load_files(paths: Mapping[str, str | Path]) -> dict[str, memoryview]:
    """Read files from any paths, by the names that they would have in a folder."""
    files = {}
    for name, path in paths.items():
        with blame(str(path)):
            files[name] = read_file(Path(path))
    return files


def load_lines(source: str | Path) -> str:
    """Return the text of a file or of stdin. Bytes that are not UTF-8 are decoded as in file names.

    Raises InvalidFile naming the file, MemoryLimit.
    """
    with blame(reading_name(source)), memory.scope():
        return os.fsdecode(bytes(read_stdin() if str(source) == STREAM else read_file(Path(source))))


def find_photograph(folder: str | Path | StoredNames, name: str) -> Path | None:
    """Return the photograph of this name in a folder, in any spelling of picture_names(); None if there is none.

    Composed and decomposed names are equal. Raises OSError for a name that the system cannot look up.
    """
    stored = folder if isinstance(folder, StoredNames) else StoredNames(Path(folder))
    fault: OSError | None = None
    for spelled in picture_names(name) if name else ():
        path = stored.path(spelled)
        try:
            if stat.S_ISREG(path.stat().st_mode):
                return path
        except (FileNotFoundError, NotADirectoryError):
            pass
        except OSError as error:  # too long, perhaps only with this extension
            fault = fault or error
    if fault is not None:
        raise fault
    return None


def is_picture(path: str | Path) -> bool:
    """True if a file has the extension of a PNG, a JPEG or a HEIC."""
    return Path(path).name.lower().endswith(PICTURES)


def picture_in(path: str | Path) -> Path | None:
    """Return the path of a picture, also of an animation, or of the first picture in a folder.

    None if there is none.
    """
    path = Path(path)
    if path.is_dir():
        with blame(str(path)):
            return next((file for file in sorted(path.iterdir()) if is_picture(file)), None)
    return path if is_picture(path) or path.suffix.lower() == ".gif" else None


class Truth(Sequence[Any]):
    """The photographs NAME.png of these names in a folder, as objects of the type `image`.

    Each photograph is read at every access, because all of them may not fit into memory at once.
    """

    def __init__(self, folder: str | Path, names: Iterable[str], image: type[Any]) -> None:
        stored = StoredNames(Path(folder))
        self._paths, self._image = [stored.path(f"{name}.png") for name in names], image

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, i: Any) -> Any:
        return load(self._paths[i], self._image)


def load_photograph(path: str | Path, size: tuple[int, int] | None = None) -> Any:
    """Return (H, W, 4) uint8: sRGB with straight alpha as in the file; alpha is 255 if the file has none.

    size: (W, H) of the camera, see decode_photograph(). Raises InvalidFile, MemoryLimit.
    """
    with blame(str(path)):
        with memory.scope():
            pixels = load_photographs().decode_photograph(_read_photograph(path), size)
        return memory.kept(pixels)


def check_photograph(path: str | Path) -> PhotographMetadata:
    """Return what a photograph says that load_photograph() can read. Raises InvalidFile, MemoryLimit."""
    with blame(str(path)), memory.scope():
        return load_photographs().check_photograph(_read_photograph(path))


def _read_photograph(path: str | Path) -> memoryview:
    view = read_file(Path(path))
    if not len(view):
        raise InvalidFile("is empty; allowed: a PNG, a JPEG or a HEIC")
    return view


def copy_photograph(path: str | Path, to: str | Path) -> None:
    """Copy a photograph; if it is a HEIC, as JPEG of the same name. Raises InvalidFile, MemoryLimit, OutputError."""
    with blame(str(path)), memory.scope():
        view, pictures = _read_photograph(path), load_photographs()
        data = pictures.jpeg_of_heic(view) if pictures.is_heic(view) else view
        with blame(str(to), OutputError):
            Path(to).write_bytes(data)


def is_heic(path: str | Path) -> bool:
    """True if a file is a HEIC, which an iPhone stores, whatever its extension is. Raises InvalidFile."""
    with blame(str(path)), Path(path).open("rb") as file:
        return load_photographs().is_heic(memoryview(file.read(HEAD)))


def load_metadata(path: str | Path) -> PhotographMetadata:
    """Return what a photograph says of itself, in its first bytes; a HEIC anywhere. Raises InvalidFile, MemoryLimit."""
    with blame(str(path)), memory.scope():
        with Path(path).open("rb") as file:
            view = memoryview(file.read(_HEAD_METADATA))
        pictures = load_photographs()
        return pictures.read_metadata(read_file(Path(path)) if pictures.is_heic(view) else view)


def load_thumbnail(path: str | Path, edge: int) -> bytes:
    """Return a picture as a PNG of at most `edge` pixels per side. Raises InvalidFile, MemoryLimit."""
    with blame(str(path)), memory.scope():
        return load_photographs().encode_thumbnail(read_file(Path(path)), edge)


def load_preview(path: str | Path, edge: int, size: tuple[int, int] | None = None) -> bytes:
    """Return a photograph as a JPEG of at most `edge` pixels per side. Raises InvalidFile, MemoryLimit.

    size: (W, H) of the camera, see decode_photograph().
    """
    with blame(str(path)), memory.scope():
        return load_photographs().encode_preview(read_file(Path(path)), edge, size)
