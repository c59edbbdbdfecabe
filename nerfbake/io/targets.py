"""Write a file or a folder completely or not at all, and replace an existing one atomically.

An output is written under a temporary name beside the target, `.NAME.<16 random digits>.part`, and then renamed. The
writer holds a lock (flock) on the temporary file: two writers never share a name, and the next writer of the same
target removes the files that dead writers have left. It recognises them by the missing lock, independent of process
IDs.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from nerfbake.errors import BudgetMissed, OutputError
from nerfbake.io.own_files import lock
from nerfbake.io.own_folders import FolderContents, require_apart
from nerfbake.io.sources import blame, broken_link

_PART, _OLD = "part", "old"
_LONGEST_NAME = 200  # of 255 bytes, to leave room for the digits and the suffix
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


def require_absent(target: str | Path, *, force: bool, parents: bool = False) -> None:
    """Raise OutputError if the target exists and must not be replaced, or if its folder cannot be written to.

    Call this before the work. parents: missing folders will be created.
    """
    if str(target) == "-":
        return
    _require_name(target)
    if Path(target).is_dir():
        raise OutputError("is a folder; allowed: a file", source=str(target))
    broken = broken_link(target)
    if broken and not (force and Path(os.path.realpath(target)).parent.is_dir()):
        raise OutputError(f"{broken}; allowed: a new file", source=str(target))
    if not force and os.path.lexists(target) and _is_regular(Path(target)):
        raise OutputError("exists already; allowed: a new file, or `force`", source=str(target))
    if not parents:
        _require_place(target)


def require_room(targets: Sequence[str], *, force: bool) -> None:
    """require_absent() for several files, which also must not replace each other."""
    known: set[str] = set()
    for target in targets:
        if target in known:
            raise OutputError("would be written twice; allowed: a unique name for each picture", source=target)
        known.add(target)
        require_absent(target, force=force, parents=True)
    for folder in {Path(target).parent for target in targets}:
        there = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), None)
        if there is not None and not there.is_dir():
            raise OutputError("is not a folder; allowed: a new or another folder", source=str(there))


def require_no_folder(target: str | Path, contents: FolderContents, *, force: bool, inputs: Sequence[str] = ()) -> None:
    """Raise OutputError if the target folder exists and must not be replaced, or cannot be created.

    Call this before the work. contents: the kind of folder that is written; no folder with other contents is replaced.
    inputs: the files and folders that are read; no folder that contains one of them, the working folder or the home
    folder is replaced.
    """
    path = Path(target)
    _require_name(path)
    with blame(str(target), OutputError):
        _require_replaceable(path, contents, force=force, inputs=inputs)
    _require_place(path)


def _require_replaceable(path: Path, contents: FolderContents, *, force: bool, inputs: Sequence[str] = ()) -> None:
    """Raise OutputError, OSError if there is something at the path that must not be replaced by a folder."""
    if not path.is_dir():
        if os.path.lexists(path):
            raise OutputError(f"{broken_link(path) or 'is not a folder'}; allowed: a new folder")
        return
    require_apart(path, inputs)
    problem = contents.problem(path)
    if not force and any(path.iterdir()):
        raise OutputError(
            f"exists already, and {problem}; allowed: a new or empty folder"
            if problem
            else "exists already; allowed: a new or empty folder, or `force`"
        )
    if problem:
        raise OutputError(f"{problem}; allowed: a new or empty folder, or one with nothing but {contents.title}")


def require_rejected_absent(target: str | Path, *, force: bool) -> None:
    """Raise OutputError if TARGET.rejected exists and must not be replaced. Call this before the work."""
    require_absent(rejected_path(target), force=force)


def is_pipe_or_device(target: str | Path) -> bool:
    """True if there is something at the path that is neither a file nor a folder, and is written to directly."""
    try:
        mode = Path(target).stat().st_mode
    except (OSError, ValueError):
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


@contextmanager
def replacing(target: Path, *, force: bool) -> Iterator[IO[bytes]]:
    """A new file that replaces the target if the block succeeds, and is deleted if it fails."""
    with replacing_file(target, force=force) as part, open(part, "wb") as file:
        yield file


@contextmanager
def replacing_file(target: Path, *, force: bool) -> Iterator[Path]:
    """The path of a new, empty file that replaces the target if the block succeeds.

    The file becomes TARGET.rejected if the block raises BudgetMissed, and is deleted after any other error. It gets the
    permissions of the file that it replaces. If the target is a pipe or a device, the path is the target itself,
    because a rename would replace the device.
    """
    require_absent(target, force=force)
    rejected, target = rejected_path(target), Path(os.path.realpath(target))
    if target.exists() and not _is_regular(target):
        yield target
        return
    _sweep(target)
    with _locked_part(target) as part:
        try:
            yield part
            _keep_mode(part, target)
            _put(part, target, force=force)
        except BudgetMissed:
            require_absent(rejected, force=force)
            shutil.move(part, rejected)
            raise
        finally:
            part.unlink(missing_ok=True)


def _put(part: Path, target: Path, *, force: bool) -> None:
    """Rename a finished file; without `force` only if no other process has written the target in the meantime."""
    if not force:
        try:
            os.link(part, target)  # fails where a rename would replace
            return
        except FileExistsError:
            found = "was written by another process; allowed: a new file, or `force`"
            raise OutputError(found, source=str(target)) from None
        except OSError:
            pass  # the file system has no hard links
    part.replace(target)


def _put_all(part: Path, target: Path, names: Sequence[str], *, force: bool) -> None:
    """Rename finished files of a folder to the folder of the target; if one of them fails, remove those before it."""
    put: list[Path] = []
    try:
        for name in names:
            place = target.with_name(name)
            _keep_mode(part / name, place)
            _put(part / name, place, force=force)
            put.append(place)
    except OutputError:  # another process has written one of them in the meantime
        for place in put:
            place.unlink(missing_ok=True)
        raise


@contextmanager
def replacing_files(target: Path, names: Sequence[str], *, force: bool) -> Iterator[Path]:
    """A new folder for a file and those beside it, `names`, which replace existing ones if the block succeeds.

    They are replaced one by one, the target last, so that it never refers to a file that is missing. The folder becomes
    TARGET.rejected if the block raises BudgetMissed, and is deleted after any other error.
    """
    beside = [name for name in names if name != target.name]
    for path in (target, *(target.with_name(name) for name in beside)):
        require_absent(path, force=force)
        if not _is_regular(path):
            raise OutputError("is not a regular file; allowed: a file, with others beside it", source=str(path))
    rejected = rejected_path(target)
    _sweep(target)
    with _locked_part(target, folder=True) as part:
        try:
            yield part
            _put_all(part, target, (*beside, target.name), force=force)
        except BudgetMissed:
            contents = _these((*beside, target.name))
            require_no_folder(rejected, contents, force=force)
            with blame(str(rejected), OutputError):
                _put_folder(part, rejected, contents, force=force)
            raise
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _these(names: Sequence[str]) -> FolderContents:
    """The contents of a folder with files of these names."""
    return FolderContents("the same files", re.compile("|".join(map(re.escape, names))), lambda files: True)


def keep_pending(part: Path, kept: Path, *, folder: bool) -> None:
    """Rename a file or a folder that was not given its name yet. folder: a file with those beside it, to a folder."""
    whole = part if part.is_dir() else part.parent
    if not folder and not part.is_dir():
        require_absent(kept, force=True)
        shutil.move(part, kept)
        return
    contents = _these([str(path.relative_to(whole)) for path in whole.rglob("*") if path.is_file()])
    require_no_folder(kept, contents, force=True)
    _put_folder(whole, kept, contents, force=True)


@contextmanager
def replacing_folder(target: Path, contents: FolderContents, *, force: bool) -> Iterator[Path]:
    """A new folder that replaces the target if the block succeeds.

    The folder becomes TARGET.rejected if the block raises BudgetMissed, and is deleted after any other error. Linux
    exchanges the old and the new folder atomically. Elsewhere the old folder is renamed first; if the process dies at
    that moment, the next writer restores it. contents: the kind of folder that is written, see require_no_folder().
    """
    require_no_folder(target, contents, force=force)
    rejected, target = rejected_path(target), Path(os.path.realpath(target))
    _sweep(target)
    with _locked_part(target, folder=True) as part:
        try:
            yield part
            _put_folder(part, target, contents, force=force)
        except BudgetMissed:
            require_no_folder(rejected, contents, force=force)
            with blame(str(rejected), OutputError):
                _put_folder(part, Path(os.path.realpath(rejected)), contents, force=force)
            raise
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _put_folder(part: Path, target: Path, contents: FolderContents, *, force: bool) -> None:
    """Rename a finished folder. What is there is looked at again: another process may have written it meanwhile.

    Without `force`, only a folder that is empty is replaced. Raises OutputError, OSError.
    """
    _keep_mode(part, target)
    try:
        part.rename(target)  # replaces an empty folder, and fails for any other
        return
    except OSError as error:
        if error.errno == errno.EXDEV:  # TARGET.rejected stands beside a link to another file system
            with _locked_part(target, folder=True) as copy:
                try:
                    shutil.copytree(part, copy, dirs_exist_ok=True)
                    _put_folder(copy, target, contents, force=force)
                finally:
                    shutil.rmtree(copy, ignore_errors=True)
            return
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise
    if not force:
        raise OutputError("was written by another process; allowed: a new or empty folder, or `force`")
    _require_replaceable(target, contents, force=force)
    if not _exchange(part, target):
        old = part.with_suffix(f".{_OLD}")
        target.replace(old)
        part.replace(target)
        shutil.rmtree(old, ignore_errors=True)


def rejected_path(target: str | Path) -> Path:
    """The path of a result that misses its quality limit."""
    return Path(f"{Path(target)}.rejected")


@contextmanager
def _locked_part(target: Path, *, folder: bool = False) -> Iterator[Path]:
    """Create an empty file or folder with a unique name, locked for the duration of the block."""
    while True:
        part = target.with_name(f".{_stem(target)}.{os.urandom(8).hex()}.{_PART}")
        if folder:
            part.mkdir()
            try:
                handle = os.open(part, os.O_RDONLY)
            except FileNotFoundError:
                continue  # another writer's _sweep() removed it before it was locked
        else:
            handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
        try:
            if _is_ours(part, handle):
                yield part
                return
        finally:
            os.close(handle)


def _is_ours(part: Path, handle: int) -> bool:
    """Lock a new part. False if another writer's _sweep() removed it before it was locked."""
    locked = lock(handle)
    if locked is None:
        return True  # without locks, _sweep() removes nothing
    return locked and part.exists() and os.path.samestat(part.stat(), os.fstat(handle))


def _sweep(target: Path) -> None:
    """Remove what dead writers of this target have left; restore a folder that one of them had renamed."""
    ours = re.compile(rf"\.{re.escape(_stem(target))}\.[0-9a-f]{{16}}\.({_PART}|{_OLD})")
    with suppress(OSError):
        for entry in os.scandir(target.parent):
            if (found := ours.fullmatch(entry.name)) and not entry.is_symlink():
                with suppress(OSError):
                    _sweep_one(Path(entry.path), target, moved_aside=found[1] == _OLD)


def _sweep_one(left: Path, target: Path, *, moved_aside: bool) -> None:
    handle = os.open(left, os.O_RDONLY)
    try:
        if not lock(handle):
            return  # its writer is still running, or this cannot be known
        if moved_aside and not target.exists():
            left.replace(target)
        elif left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two paths atomically. False if the system does not support this."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        rename: int = libc.renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    except (AttributeError, OSError, TypeError):  # TypeError: on Windows, a library has a name
        return False
    return rename == 0


def _keep_mode(part: Path, target: Path) -> None:
    with suppress(FileNotFoundError):
        part.chmod(stat.S_IMODE(target.stat().st_mode))


def _stem(target: Path) -> str:
    return os.fsdecode(os.fsencode(target.name)[:_LONGEST_NAME])


def _is_regular(path: Path) -> bool:
    return not path.exists() or stat.S_ISREG(path.stat().st_mode)


def _require_place(target: str | Path) -> None:
    """Raise OutputError, with the folder that is missing or the system's message, if nothing can be created there."""
    path = Path(os.path.realpath(target))
    if not path.is_dir() and not _is_regular(path):
        return  # a pipe or a device, which is written to directly
    if not os.path.lexists(path.parent):
        folder = Path(target).parent
        raise OutputError(f"its folder {folder} does not exist; allowed: an existing folder", source=str(target))
    with blame(str(target), OutputError):
        with suppress(FileNotFoundError):
            path.lstat()  # fails if there is a file in place of a folder
        with tempfile.TemporaryFile(dir=path.parent):  # root may write everywhere, but nothing can be created in /proc
            pass


def _require_name(target: str | Path) -> None:
    try:
        encoded = os.fsencode(target)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise OutputError("is not a valid file name; allowed: a path", source=str(target))
    with blame(str(target), OutputError), suppress(FileNotFoundError, NotADirectoryError):
        Path(target).stat()  # fails if the name is too long, or a loop of links
