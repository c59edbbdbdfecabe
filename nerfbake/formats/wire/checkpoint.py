"""Read and write checkpoints of jobs: a JSON object and named arrays in one .npz.

facts.npy      uint8: a JSON object
NAME.npy, ...  numbers of any shape, stored as they are
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import parse_object
from nerfbake.formats.wire.npz import NpzReader, write_npz

_FACTS = "facts"
_MOST_FACTS = 1 << 24  # bytes

Arrays = dict[str, npt.NDArray[Any]]


def encode_checkpoint(facts: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> Iterator[bytes | memoryview]:
    text = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    yield from write_npz({_FACTS: text, **arrays})


def decode_checkpoint(view: memoryview) -> tuple[dict[str, Any], Arrays]:
    """Return the facts and the arrays, which are views of the file if aligned. The caller checks their contents."""
    reader = NpzReader(view)
    text = reader.array(_FACTS, limit=_MOST_FACTS)
    if text.dtype != np.uint8 or text.ndim != 1:
        raise InvalidFile(Problem(_FACTS, f"has dtype {text.dtype}, shape {text.shape}", "a line of bytes"))
    arrays = {name: reader.array(name) for name in reader.names if name != _FACTS}
    for name, array in arrays.items():
        if array.dtype.kind not in "biuf":
            raise InvalidFile(Problem(name, f"has dtype {array.dtype}", "numbers"))
    return parse_object(text.tobytes(), _FACTS), arrays
