"""nerf2mesh's mlp.json: the weights as nested lists, `bound`, and `cascade`, the number of textures."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import number, parse_object, shown, table, whole

MAX_CASCADES = 16
_NAME = "mlp.json"


class Mlp(NamedTuple):
    """w0 (6, h) and w1 (h, 3) float32; scene.specular checks their shapes and values."""

    w0: npt.NDArray[np.float32]
    w1: npt.NDArray[np.float32]
    bound: float
    cascades: int


def decode_mlp(view: memoryview) -> Mlp:
    content = parse_object(view, _NAME)
    cascades = whole(content, "cascade", _NAME, default=1, low=1, high=MAX_CASCADES)
    bound = number(content, "bound", _NAME, default=1.0, low=1e-9, high=1e9)
    if extra := sorted(
        key for key in content if key.startswith("net.") and key not in ("net.0.weight", "net.1.weight")
    ):
        raise InvalidFile(
            Problem(_NAME, f"has {shown(extra[0])}", "two layers without bias: net.0.weight and net.1.weight")
        )
    return Mlp(_weights(content, "net.0.weight"), _weights(content, "net.1.weight"), bound, cascades)


def encode_mlp(mlp: Mlp) -> bytes:
    content = {
        "net.0.weight": mlp.w0.tolist(),
        "net.1.weight": mlp.w1.tolist(),
        "bound": mlp.bound,
        "cascade": mlp.cascades,
    }
    return json.dumps(content).encode()


def _weights(content: dict[str, Any], key: str) -> npt.NDArray[np.float32]:
    if key not in content:
        raise InvalidFile(Problem(_NAME, f"has no {key}", "net.0.weight and net.1.weight"))
    return table(content[key], f"{_NAME}: {key}", (None, None)).astype(np.float32)
