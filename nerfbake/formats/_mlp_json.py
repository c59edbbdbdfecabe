"""nerf2mesh's mlp.json: the weights as nested lists, `bound`, and `cascade`, the number of textures."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, MemoryLimit, Problem

MAX_CASCADES = 16
_MAX_SIZE = 16 << 20
_NAME = "mlp.json"


class Mlp(NamedTuple):
    """w0 (6, h) and w1 (h, 3) float32; scene.specular checks their shapes and values."""

    w0: npt.NDArray[np.float32]
    w1: npt.NDArray[np.float32]
    bound: float
    cascades: int


def decode_mlp(view: memoryview, *, max_memory: int) -> Mlp:
    if len(view) > min(_MAX_SIZE, max_memory):
        raise MemoryLimit(_NAME, len(view), min(_MAX_SIZE, max_memory))
    try:
        content = json.loads(bytes(view))
    except (ValueError, RecursionError) as error:
        raise InvalidFile(Problem(_NAME, f"is no JSON ({error})", "an object with the weights")) from None
    if not isinstance(content, dict):
        raise InvalidFile(Problem(_NAME, f"holds a {type(content).__name__}", "an object with the weights"))
    cascades = content.get("cascade", 1)
    if type(cascades) is not int or not 1 <= cascades <= MAX_CASCADES:
        raise InvalidFile(Problem(f"{_NAME}: cascade", f"is {str(cascades)[:40]}", f"1 to {MAX_CASCADES}"))
    bound = content.get("bound", 1.0)
    if type(bound) not in (int, float) or not 0 < bound < 1e9:
        raise InvalidFile(Problem(f"{_NAME}: bound", f"is {str(bound)[:40]}", "a length above 0"))
    if extra := sorted(
        key for key in content if key.startswith("net.") and key not in ("net.0.weight", "net.1.weight")
    ):
        raise InvalidFile(Problem(_NAME, f"has {extra[0]}", "two layers without bias: net.0.weight and net.1.weight"))
    return Mlp(_weights(content, "net.0.weight"), _weights(content, "net.1.weight"), float(bound), cascades)


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
    try:
        weights = np.array(content[key], np.float64)
    except (ValueError, TypeError):
        raise InvalidFile(Problem(f"{_NAME}: {key}", "is no table of numbers", "rows of equal length")) from None
    if weights.ndim != 2:
        raise InvalidFile(Problem(f"{_NAME}: {key}", f"has shape {weights.shape}", "a row for each input"))
    with np.errstate(over="ignore"):
        return weights.astype(np.float32)
