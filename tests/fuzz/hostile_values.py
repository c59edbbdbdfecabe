"""Numbers and texts that often break readers."""

from __future__ import annotations

import struct
from random import Random

WHOLE = [0, 1, 2, 3, 7, 8, 63, 64, 127, 128, 255, 256, 4095, 4096, 32767, 32768, 65535, 65536, 1 << 20, 1 << 24]
WHOLE += [(1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 32, 1 << 48, (1 << 63) - 1, 1 << 63, (1 << 64) - 1]
REAL = [0.0, -0.0, 1.0, -1.0, 0.5, 1e-300, 5e-324, 1e-38, 1e-45, 6.1e-5, 65504.0, 65520.0, 1e5, 1e9, 1e15, 1e19]
REAL += [3.4e38, 3.5e38, 1e150, 1e200, 1.7e308, float("inf"), float("nan"), 2147483647.5, 1e-12, 16777217.0]
REAL += [453000.125, 5012345.6, 8388608.5]  # of a map, where float32 loses digits
TEXTS = ["", "\0", "a\0b", "\n", "\x1b[2J", "../../x", "/etc/passwd", "SH9", "SH0", "SH9999", "RGBA", "SG25", "é" * 50]
TEXTS += ["\ufffe", "\U0010ffff", "\u202e", "x" * 300, "x" * 5000, "-1", "1e999", "nan", "<f4", "|O", "float16"]
TEXTS += ["Vertical axis: 0 0 1", "Vertical axis: 1e999 0 0", "trbf_center", "f_dc_3", "ushort", "double"]


def whole(random: Random, *, signed: bool = True) -> int:
    """A size, index or offset that is invalid or close to a limit."""
    value = random.choice(WHOLE) if random.random() < 0.8 else random.getrandbits(random.choice((8, 16, 32, 64)))
    value += random.choice((0, 0, 0, -1, 1))
    return -value if signed and random.random() < 0.25 else value


def real(random: Random) -> float:
    return random.choice(REAL) * random.choice((1, 1, 1, -1))


def text(random: Random) -> str:
    return random.choice(TEXTS)


def word(random: Random, size: int) -> bytes:
    """The bytes of a little-endian integer of 1, 2, 4 or 8 bytes, or of a float of 2, 4 or 8 bytes."""
    if size in (2, 4, 8) and random.random() < 0.35:
        value, form = real(random), {2: "<e", 4: "<f", 8: "<d"}[size]
        try:
            return struct.pack(form, value)
        except OverflowError:
            return struct.pack(form, float("inf"))
    return (whole(random) & ((1 << 8 * size) - 1)).to_bytes(size, "little")
