"""Take a file out of what people send it in: gzip around it, or a zip archive with this one file.

    1F 8B | gzip (RFC 1952), of any content               PK 03 04 | zip, of which zip_reader.py describes the checks

Archives that are scenes themselves (.npz, .sog, checkpoints of torch) have no members with the names of other scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.deflate import gunzip
from nerfbake.formats.wire.zip_reader import ZIP_MAGIC, ZipFolder, npz_keys, own_names

_GZIP, _DEFLATED = b"\x1f\x8b", 8
_ENDING = ".gz"
_SHOWN = 3  # names in a message


class Wrapped(NamedTuple):
    """The bytes of the file, its name, and for a file of an archive the files in the same folder of the archive."""

    view: memoryview
    name: str
    beside: Mapping[str, memoryview] | None


def is_gzip(view: memoryview) -> bool:
    """Return True for the start of a gzip stream."""
    return bytes(view[:2]) == _GZIP and bytes(view[2:3]) == bytes([_DEFLATED])


def unwrap_gzip(view: memoryview, name: str) -> Wrapped:
    """Return the file in gzip; its name is without .gz. Raises InvalidFile, MemoryLimit."""
    size = int.from_bytes(view[-4:], "little")  # of the last stream, modulo 2^32
    memory.require("the file in gzip", size)
    plain = name[: -len(_ENDING)] if name.lower().endswith(_ENDING) else name
    return Wrapped(gunzip(view, "gzip"), plain, None)


def unwrap_zip(view: memoryview, endings: Sequence[tuple[str, ...]]) -> Wrapped | None:
    """Return the file in an archive whose name has one of these endings; None if there is none.

    endings: of main files, and of files that count only if there is no main file. Raises InvalidFile if there are
    several, MemoryLimit.
    """
    if bytes(view[:4]) not in ZIP_MAGIC:
        return None
    names = own_names(npz_keys(view))
    for group in endings:
        found = [name for name in names if name.lower().removesuffix(_ENDING).endswith(group)]
        if len(found) > 1:
            listed = ", ".join(sorted(found)[:_SHOWN])
            raise InvalidFile(Problem("the archive", f"has {len(found):,} scenes: {listed[:120]}", "one scene"))
        if found:
            folder, slash, name = found[0].rpartition("/")
            files = ZipFolder(view, "a zip archive").below(folder + slash)
            if name not in files:  # npz_keys() found it by the header in front of it
                raise InvalidFile(Problem("zip directory", f"does not list {found[0][:80]}", "a complete zip archive"))
            return Wrapped(files[name], name, files)
    return None
