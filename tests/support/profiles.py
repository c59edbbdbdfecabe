"""ICC profiles of RGB colours, as phones and cameras add them to photographs."""

from __future__ import annotations

import struct

# The colorants of Display P3 and Adobe RGB (1998), adapted to D50, as their profiles have them.
DISPLAY_P3 = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407))
ADOBE_RGB = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
SRGB = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141))
SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
GAMMA = (563 / 256, 1.0, 0.0, 0.0, 0.0)  # of Adobe RGB


def profile_of(colorants: tuple[tuple[float, ...], ...], curve: tuple[float, ...]) -> bytes:
    """A profile of a display: the XYZ of red, green and blue, and ((a x + b)^g if x >= d else c x) as (g, a, b, c, d).

    Source: ICC.1:2010, 7.2, 10.15 and 10.28.
    """
    places = [b"XYZ \0\0\0\0" + _fixed(*colorant) for colorant in colorants]
    tone = b"para\0\0\0\0\0\3\0\0" + _fixed(*curve)
    tags = dict(zip((b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"), (*places, tone, tone, tone), strict=True))
    at, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, value in tags.items():
        table += name + struct.pack(">II", at + len(body), len(value))
        body += value
    head = struct.pack(">I4sI4s4s4s", at + len(body), b"lcms", 0x04000000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + _fixed(0.9642, 1.0, 0.8249)
    return head.ljust(128, b"\0") + table + body


def _fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))
