"""PlenOctrees as archives of arrays, as written by svox."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np

from nerfbake.scene.camera import Camera, Cameras, look_at
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.lens import Lens
from nerfbake.scene.n3tree import N3Tree
from tests.support.scenes import n3tree


def archive(arrays: dict[str, Any], *, deflated: bool = True) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if deflated else np.savez)(file, **arrays)
    return file.getvalue()


def svox(tree: N3Tree) -> dict[str, Any]:
    """The arrays that svox writes for a tree."""
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
    """The arrays of a valid tree: three nodes, each the child of the previous one."""
    return svox(n3tree(splits=[(0, (0, 0, 0)), (1, (1, 1, 1))]))


def held_out() -> HeldOut:
    """Every second pixel of two photographs, one of them with lens distortion."""
    front, side = (Camera(6, 5, 7.0, look_at(np.zeros(3), turn, 0.4, 3.0), name) for turn, name in ((0, "a"), (1, "b")))
    bent = replace(side, lens=Lens("polynomial", k=(0.01, -0.002), p=(0.001, 0.0)))
    random = np.random.default_rng(4)
    photographs = [random.integers(0, 256, (5, 6, 3)) / 255 for _ in range(2)]
    whole = HeldOut.of(Cameras((front, bent), samples=2), photographs, background=(0.25, 0.5, 1.0))
    return replace(whole, every=2, pixels=tuple(pixels[::2, ::2] for pixels in whole.pixels))


def quantised() -> dict[str, Any]:
    arrays = {key: value for key, value in sound().items() if key in ("child", "invradius3", "offset", "data_format")}
    shape = arrays["child"].shape
    arrays["quant_colors"] = np.zeros((1, 16, 3), np.float16)
    arrays["quant_map"] = np.zeros((1, *shape), np.uint16)
    return arrays | {"sigma": np.ones(shape, np.float16)}
