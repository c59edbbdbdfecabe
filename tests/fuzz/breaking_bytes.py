"""Break bytes without knowledge of their structure, except the width of their numbers."""

from __future__ import annotations

from random import Random

from tests.fuzz.hostile_values import word


def break_words(random: Random, data: bytes, other: bytes = b"", *, widths: tuple[int, ...] = (1, 2, 4, 8)) -> bytes:
    """Change a number of one of these widths, swap two, or copy one from another file; mostly near the start."""
    broken, width = bytearray(data), random.choice(widths)
    count = len(broken) // width
    if not count:
        return data
    at = width * _near_the_start(random, count)
    how = random.random()
    if how < 0.6:
        broken[at : at + width] = word(random, width)
    elif how < 0.8:
        step = random.choice((-8, -1, 1, 2, 8))
        value = int.from_bytes(broken[at : at + width], "little") + step
        broken[at : at + width] = (value & ((1 << 8 * width) - 1)).to_bytes(width, "little")
    elif how < 0.9 or len(other) < width:
        there = width * _near_the_start(random, count)
        broken[at : at + width], broken[there : there + width] = broken[there : there + width], broken[at : at + width]
    else:
        there = width * random.randrange(len(other) // width)
        broken[at : at + width] = other[there : there + width]
    return bytes(broken)


def break_bytes(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Flip bits, remove, repeat or overwrite a piece, insert a piece of another file, or truncate the file."""
    start = _near_the_start(random, len(data) + 1)
    end = min(len(data), start + random.choice((1, 1, 2, 4, 8, 16, 64, 1000)))
    match random.randrange(8):
        case 0 | 1:
            broken = bytearray(data)
            for _ in range(random.choice((1, 1, 2, 8))):
                if broken:
                    broken[_near_the_start(random, len(broken))] ^= 1 << random.randrange(8)
            return bytes(broken)
        case 2:
            return data[:start] + data[end:]
        case 3:
            return data[:end] + data[start:end] * random.choice((1, 1, 3, 100)) + data[end:]
        case 4:
            return data[:start] + random.choice((b"\0", b"\xff", b" ")) * (end - start) + data[end:]
        case 5:
            return data[:start]
        case 6:
            there = random.randrange(len(other) + 1)
            return data[:start] + other[there : there + end - start] + data[end:]
        case _:
            return data[:start] + other[random.randrange(len(other) + 1) :]


def _near_the_start(random: Random, count: int) -> int:
    """A random number from 0 to count - 1, mostly small: headers come first, and are shorter than the payload."""
    return int(count * random.random() ** random.choice((1, 1, 3, 6)))
