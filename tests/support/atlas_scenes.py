"""Small synthetic specular fields, stage-1 folders and atlases."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire.picture import encode_texture
from nerfbake.scene.atlas import Method, OctahedralAtlas
from nerfbake.scene.stage1 import SpecularField

OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def mlp_json(hidden: int = 8, seed: int = 0, **changes: Any) -> bytes:
    random = np.random.default_rng(seed)
    content: dict[str, Any] = {
        "net.0.weight": random.normal(size=(6, hidden)).tolist(),
        "net.1.weight": random.normal(size=(hidden, 3)).tolist(),
        "bound": 1.0,
        "cascade": 1,
    }
    content.update(changes)
    return json.dumps({key: value for key, value in content.items() if value is not None}).encode()


def texture(H: int = 24, W: int = 32, seed: int = 0) -> npt.NDArray[np.uint8]:
    """(H, W, 3) uint8: smooth colour gradients with noise."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:H, :W] / max(H, W)
    soft = np.stack([x, y, 0.5 + 0.5 * np.sin(6 * x + 3 * y)], axis=-1)
    return np.clip(255 * soft + random.normal(0, 6, (H, W, 3)), 0, 255).astype(np.uint8)


def field(H: int = 24, W: int = 32, hidden: int = 8, seed: int = 0) -> SpecularField:
    random = np.random.default_rng(seed)
    w0, w1 = random.normal(size=(6, hidden)), random.normal(size=(hidden, 3))
    return SpecularField(texture(H, W, seed), w0.astype(np.float32), w1.astype(np.float32), np.ones((H, W), bool))


def stage1_folder(path: Path, **files: bytes | None) -> Path:
    """Write a stage-1 folder that can be baked, and return its path.

    files: contents by file name, with _ for the dot. They replace or add files; None removes a file.
    """
    path.mkdir(parents=True)
    content: dict[str, bytes | None] = {
        "mlp_json": mlp_json(),
        "feat1_0_png": encode_texture(texture()),
        "feat0_0_png": encode_texture(texture(seed=1)),
        "mesh_0_obj": OBJ,
        **files,
    }
    for name, data in content.items():
        if data is not None:
            stem, _, ending = name.rpartition("_")
            (path / f"{stem}.{ending}").write_bytes(data)
    return path


def random_atlas(method: Method, border: int = 1) -> OctahedralAtlas:
    """An atlas with random maps, labels and features."""
    random = np.random.default_rng(11)
    T, K = {"kmeans": (300, 300), "affine": (40, 10), "grid": (27, 1)}[method]
    return OctahedralAtlas(
        method,
        random.integers(0, 256, (T, 8, 8, 3), np.uint8),
        random.integers(0, K, (20, 30)).astype(np.uint16),
        None if method == "kmeans" else random.integers(0, 256, (20, 30, 3), np.uint8),
        border,
        2.5 if method == "affine" else 1.0,
        random.integers(1, 256, K).astype(np.uint8) if method == "affine" else None,
    )


def looked_up(
    atlas: OctahedralAtlas, texels: npt.NDArray[np.int64], directions: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(texels, 3): the colours that nerfbake looks up with bilinear filtering."""
    features = np.zeros((len(texels), 3), np.uint8) if atlas.features is None else atlas.features.reshape(-1, 3)[texels]
    tiles, weights = atlas.terms(atlas.labels.reshape(-1)[texels], features)
    shown = atlas.show(directions, "bilinear")
    rows = shown[tiles, np.arange(len(texels))[:, None]]
    return np.asarray((weights[..., None] * rows).sum(axis=1), np.float64)
