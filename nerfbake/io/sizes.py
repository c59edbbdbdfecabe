"""How large files are once they are unpacked, told from their ends alone."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path


def decoded_bytes(path: str | Path) -> int:
    """Bytes of a file, of an .npz those of its arrays, of a folder those of its files; 0 where there is nothing.

    An estimate: what a broken file says of itself is believed.
    """
    try:
        if Path(path).is_dir():
            return sum(entry.stat().st_size for entry in os.scandir(path) if entry.is_file())
        if Path(path).name.lower().endswith(".npz"):
            with zipfile.ZipFile(path) as archive:
                return sum(info.file_size for info in archive.infolist())
        return Path(path).stat().st_size
    except zipfile.BadZipFile:
        return Path(path).stat().st_size
    except (OSError, ValueError, NotImplementedError):
        return 0
