"""Grids of every type that a .nvdb file can store, and functions to encode and decode them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from nerfbake.formats.volume import nanovdb
from nerfbake.scene.volume import Volume
from tests.support.vdb_readers import index, tree

Codec = Literal["none", "zip"]
GRIDS: dict[str, Callable[..., Any]] = {
    "Float": tree,
    "Vec3f": lambda coords: tree(coords, channels=3, name="Cd"),
    "Fp16": lambda coords: tree(coords, dtype=np.float16),
    "OnIndex": index,
    "OnIndex, half": lambda coords: index(coords, channels=28, dtype=np.float16),
}


def encoded(made: Volume, *, codec: Codec = "none") -> bytes:
    return b"".join(nanovdb.encode(made, codec=codec))


def decoded(data: bytes) -> Volume:
    return nanovdb.decode(memoryview(data))
