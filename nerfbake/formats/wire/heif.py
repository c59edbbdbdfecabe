"""The library that decodes HEIC, and what it raises.

pillow-heif is optional: the extra `heic` installs it. Its wheels contain libheif and libde265 (LGPLv3), which decode,
and x265 (GPLv2), which only encodes and is never called. pi-heif is the same code without x265. It is used if it is the
only one of the two, because its last release, 1.4.0, has an older libde265: one that ends the process with signal 11 on
4 of 7,200 one-bit changes of a damaged file, of which pillow-heif 1.8.1 refuses each.
"""

from __future__ import annotations

from collections.abc import Callable

from nerfbake.errors import InvalidFile, Problem
from nerfbake.installation import command_for

# What pillow-heif 1.8 makes of libheif's errors, and what Pillow raises for what it then gets. One bit of a file is
# enough for each of them: RuntimeError is "security limit exceeded" or "invalid image size".
BROKEN = (OSError, SyntaxError, ValueError, EOFError, RuntimeError, MemoryError)


def require_heif(name: str) -> None:
    """Make Pillow able to read HEIC. Raises InvalidFile if the library for it is missing."""
    try:
        register = _opener()
    except ImportError:
        allowed = f"a PNG or a JPEG, or HEIC after: {command_for('pillow_heif')}"
        raise InvalidFile(Problem(name, "is HEIC", allowed)) from None
    register(thumbnails=False)


def _opener() -> Callable[..., None]:
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        from pi_heif import register_heif_opener as register_decoder

        return register_decoder  # type: ignore[no-any-return]
    return register_heif_opener
