"""PlenOctrees as archives of arrays, as svox writes them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from nerfbake.scene.n3tree import N3Tree
from tests.support.scenes import n3tree


def archive(arrays: dict[str, Any], *, deflated: bool = True) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if deflated else np.savez)(file, **arrays)
    return file.getvalue()


def svox(tree: N3Tree) -> dict[str, Any]:
    """The keys that svox itself writes."""
    return {
        "data_dim": np.int64(tree.data_dim),
        "child": tree.child,
        "parent_depth": np.zeros((tree.n, 2), np.int32),
        "n_internal": np.int64(tree.n),
        "n_free": np.int64(0),
        "invradius3": tree.invradius.astype(np.float32),
        "offset": tree.offset.astype(np.float32),
        "depth_limit": np.int64(10),
        "geom_resize_fact": np.float64(1),
        "data": tree.data,
        "data_format": np.array(tree.data_format),
    }


def sound() -> dict[str, Any]:
    """Three nodes, each below the one before it."""
    return svox(n3tree(splits=[(0, (0, 0, 0)), (1, (1, 1, 1))]))


def quantised() -> dict[str, Any]:
    arrays = {key: value for key, value in sound().items() if key in ("child", "invradius3", "offset", "data_format")}
    shape = arrays["child"].shape
    arrays["quant_colors"] = np.zeros((1, 16, 3), np.float16)
    arrays["quant_map"] = np.zeros((1, *shape), np.uint16)
    return arrays | {"sigma": np.ones(shape, np.float16)}
