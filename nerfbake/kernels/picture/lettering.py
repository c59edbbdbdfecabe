"""A few words in a picture: letters of five by seven dots, those that titles need."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

HEIGHT, ADVANCE = 7, 6  # dots of a letter, and from one to the next

# A row of five dots in each number, from the top; the highest bit is the left one.
_LETTERS = {
    " ": (0, 0, 0, 0, 0, 0, 0),
    "-": (0, 0, 0, 31, 0, 0, 0),
    "2": (14, 17, 1, 6, 8, 16, 31),
    "8": (14, 17, 17, 14, 17, 17, 14),
    "H": (17, 17, 17, 31, 17, 17, 17),
    "I": (14, 4, 4, 4, 4, 4, 14),
    "N": (17, 25, 21, 19, 17, 17, 17),
    "R": (30, 17, 17, 30, 20, 18, 17),
    "T": (31, 4, 4, 4, 4, 4, 4),
    "U": (17, 17, 17, 17, 17, 17, 14),
    "X": (17, 17, 10, 4, 10, 17, 17),
}


def written(text: str) -> npt.NDArray[np.bool_]:
    """(7, 6 len(text)) bool: the dots of a text of these letters."""
    rows = np.array([_LETTERS[letter] for letter in text], np.uint8).reshape(-1, HEIGHT)
    dots = np.unpackbits(rows[..., None], axis=2)[..., 3:].astype(bool)  # (letters, 7, 5)
    return np.pad(dots, ((0, 0), (0, 0), (0, ADVANCE - 5))).transpose(1, 0, 2).reshape(HEIGHT, -1)
