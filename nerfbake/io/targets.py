"""Where bytes go: a file or a folder appears whole or not at all, and what stood there is replaced in one step.

Everything is written under a name of its own beside the target, `.NAME.<16 random digits>.part`, and then renamed. A
writer holds a lock (flock) on what it is writing: two writers never share a name, and the next writer of the same
target sweeps what dead ones have left, told by the lock that nobody holds, whatever became of their process number.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from nerfbake.errors import BudgetMissed, OutputError
from nerfbake.io.sources import blame

try:
    import fcntl
except ImportError:  # no locks on this system: then nothing is swept
    fcntl = None  # type: ignore[assignment]

_PART, _OLD = "part", "old"
_LONGEST_NAME = 200  # of 255 bytes, which leaves room for the digits
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


def require_absent(target: str | Path, *, force: bool, parents: bool = False) -> None:
    """Raises OutputError if the target is there and may not be replaced, or if there is no folder that it could be
    written to: asked before the work, not after it. parents: the folders that lead there will be made.
    """
    if str(target) == "-":
        return
    _require_name(target)
    if Path(target).is_dir():
        raise OutputError("is a folder; allowed: a file", source=str(target))
    if not force and os.path.lexists(target) and _is_regular(Path(target)):
        raise OutputError("exists already; allowed: a new file, or `force`", source=str(target))
    if not parents:
        _require_place(target)


def require_room(targets: Sequence[str], *, force: bool) -> None:
    """require_absent() for files that are all to be written, which must not replace each other either."""
    known: set[str] = set()
    for target in targets:
        if target in known:
            raise OutputError("would be written twice; allowed: a name of its own for each picture", source=target)
        known.add(target)
        require_absent(target, force=force, parents=True)
    for folder in {Path(target).parent for target in targets}:
        there = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), None)
        if there is not None and not there.is_dir():
            raise OutputError("is no folder; allowed: a new or another folder", source=str(there))


def require_no_folder(target: str | Path, *, force: bool) -> None:
    """Raises OutputError if the target is there and may not be replaced, or if there is no folder that it could be
    made in: asked before the work, not after it.
    """
    path = Path(target)
    _require_name(path)
    if os.path.lexists(path) and not path.is_dir():
        raise OutputError("is no folder; allowed: a new folder", source=str(target))
    if path.is_dir() and any(path.iterdir()) and not force:
        raise OutputError("exists already; allowed: a new or empty folder, or `force`", source=str(target))
    _require_place(path)


def require_rejected_absent(target: str | Path, *, force: bool, folder: bool = False) -> None:
    """Raises OutputError if TARGET.rejected is there and may not be replaced: asked before the work."""
    (require_no_folder if folder else require_absent)(rejected_path(target), force=force)


@contextmanager
def replacing(target: Path, *, force: bool) -> Iterator[IO[bytes]]:
    """A file that takes the target's place when the block ends well, and vanishes when it does not."""
    with replacing_file(target, force=force) as part, open(part, "wb") as file:
        yield file


@contextmanager
def replacing_file(target: Path, *, force: bool) -> Iterator[Path]:
    """The path of a new, empty file that takes the target's place when the block ends well.

    It becomes TARGET.rejected if the block raises BudgetMissed, and vanishes with every other error. What it replaces
    keeps its permissions. Where the target is a pipe or a device, the path is its own: renaming over it would be a
    disaster.
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
            part.replace(target)
        except BudgetMissed:
            require_absent(rejected, force=force)
            shutil.move(part, rejected)
            raise
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def replacing_folder(target: Path, *, force: bool) -> Iterator[Path]:
    """A new folder that takes the target's place when the block ends well.

    It becomes TARGET.rejected if the block raises BudgetMissed, and vanishes with every other error. Linux exchanges
    the old and the new folder in one step. Elsewhere the old folder is moved aside first; if the process dies just
    then, the next writer puts it back.
    """
    require_no_folder(target, force=force)
    rejected, target = rejected_path(target), Path(os.path.realpath(target))
    _sweep(target)
    with _locked_part(target, folder=True) as part:
        try:
            yield part
            if target.exists():
                _keep_mode(part, target)
                if not _exchange(part, target):
                    old = part.with_suffix(f".{_OLD}")
                    target.replace(old)
                    part.replace(target)
                    shutil.rmtree(old, ignore_errors=True)
            else:
                part.replace(target)
        except BudgetMissed:
            require_no_folder(rejected, force=force)
            if rejected.is_dir():
                shutil.rmtree(rejected)
            shutil.move(part, rejected)
            raise
        finally:
            shutil.rmtree(part, ignore_errors=True)


def rejected_path(target: str | Path) -> Path:
    """What a result becomes that misses its budget."""
    return Path(f"{Path(target)}.rejected")


@contextmanager
def _locked_part(target: Path, *, folder: bool = False) -> Iterator[Path]:
    """A new, empty file or folder of a name of its own, locked for as long as the block lasts."""
    while True:
        part = target.with_name(f".{_stem(target)}.{os.urandom(8).hex()}.{_PART}")
        if folder:
            part.mkdir()
            handle = os.open(part, os.O_RDONLY)
        else:
            handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
        try:
            if _is_ours(part, handle):
                yield part
                return
        finally:
            os.close(handle)


def _is_ours(part: Path, handle: int) -> bool:
    """Locks a new part. False if a sweeper came between its making and this: then it has no name any more."""
    try:
        locked = _lock(handle)
    except OSError:
        return True  # a file system without locks, where nobody sweeps
    return locked and part.exists() and os.path.samestat(part.stat(), os.fstat(handle))


def _sweep(target: Path) -> None:
    """Removes what dead writers of this target have left; puts a folder back that one had moved aside."""
    if fcntl is None:
        return
    ours = re.compile(rf"\.{re.escape(_stem(target))}\.[0-9a-f]{{16}}\.({_PART}|{_OLD})")
    with suppress(OSError):
        for entry in os.scandir(target.parent):
            if (found := ours.fullmatch(entry.name)) and not entry.is_symlink():
                with suppress(OSError):
                    _sweep_one(Path(entry.path), target, moved_aside=found[1] == _OLD)


def _sweep_one(left: Path, target: Path, *, moved_aside: bool) -> None:
    handle = os.open(left, os.O_RDONLY)
    try:
        if not _lock(handle):
            return  # its writer lives
        if moved_aside and not target.exists():
            left.replace(target)
        elif left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _lock(handle: int) -> bool:
    """Locks an open file or folder; False if another process has done so. Raises OSError where there are no locks."""
    if fcntl is not None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _exchange(a: Path, b: Path) -> bool:
    """Gives each path what the other stands for, in one step. False where the system cannot."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        rename: int = libc.renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    except (AttributeError, OSError):
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
    """Raises OutputError, in the system's words, where nothing can be made that then becomes the target."""
    path = Path(os.path.realpath(target))
    if not path.is_dir() and not _is_regular(path):
        return  # a pipe or a device, which is written to as it stands
    with blame(str(target), OutputError):
        with suppress(FileNotFoundError):
            path.lstat()  # tells of a file where its folder should be
        path.parent.stat()
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def _require_name(target: str | Path) -> None:
    try:
        encoded = os.fsencode(target)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise OutputError("is no name that a file can have; allowed: a path", source=str(target))
    with blame(str(target), OutputError), suppress(FileNotFoundError, NotADirectoryError):
        Path(target).lstat()  # tells of a name that is too long
