"""Files in a folder that this program writes and that anybody may have made: symbolic links are never followed."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from nerfbake.errors import OutputError


def require_no_link(path: str | Path) -> None:
    """Raises OutputError where a symbolic link stands."""
    if Path(path).is_symlink():
        raise OutputError("is a symbolic link; allowed: a file or folder of its own", source=str(path))


def open_own(path: str | Path, flags: int) -> int:
    """Opens a file as os.open() does, but neither a link nor a pipe or device: an opener for open().

    Raises OutputError, OSError.
    """
    require_no_link(path)  # O_NOFOLLOW refuses it, too, but its message does not name a link
    more = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
    handle = os.open(path, flags | more, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OutputError("is no regular file; allowed: a file", source=str(path))
    return handle
