"""The rows of `bench atlas`: a method at a size each, baked from the texture and the MLP in memory to written PNGs."""

from __future__ import annotations

from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

import nerfbake
from nerfbake import io
from nerfbake.bench.measure import Work, seconds_of
from nerfbake.kernels.maths.sphere import fibonacci


class Recipe(NamedTuple):
    """A method at a size: clusters, or nodes along an axis of the grid."""

    method: str
    size: int
    map_size: int = 64

    @property
    def label(self) -> str:
        count = f"{self.size}^3" if self.method == "grid" else f"K={self.size}"
        return f"{self.method} {count}" + ("" if self.map_size == 64 else f", {self.map_size}x{self.map_size}")


RECIPES = [Recipe("kmeans", K) for K in (1, 4, 16, 64, 256, 1024, 2048)]
RECIPES += [Recipe("affine", K) for K in (4, 16, 64, 256)]
RECIPES += [Recipe("grid", 5), Recipe("grid", 7), Recipe("grid", 13, 32)]


def baking(folder: str, recipe: list[Any]) -> Work:
    """The work of baking one recipe's atlas and writing it; in a process of its own."""
    method, size, map_size = recipe
    field = io.load_folder(folder, nerfbake.Stage1).fields[0]
    options = {"method": method, "map_size": map_size} | ({"nodes": size} if method == "grid" else {"clusters": size})
    corner = np.s_[:16, :16]
    small = replace(field, features=field.features[corner].copy(), used=np.ones((16, 16), bool))
    warm = nerfbake.bake_atlas(small, **{**options, "clusters": 1, "nodes": 2})
    directions = fibonacci(100)
    nerfbake.measure_atlas_error(warm, small, directions=directions)

    def run() -> dict[str, Any]:
        atlas = nerfbake.bake_atlas(field, **options)
        with TemporaryDirectory(prefix="nerfbake-bench-") as target:
            baked = nerfbake.BakedAtlas((atlas,), (None,), {}, {})
            sizes, seconds = seconds_of(lambda: io.save_folder(target, baked, force=True))
            return {"atlas": atlas, "sizes": sizes, "write": seconds}

    def check(found: dict[str, Any]) -> dict[str, Any]:
        atlas = found["atlas"]
        error, metric = seconds_of(lambda: nerfbake.measure_atlas_error(atlas, field, directions=directions))
        held_out = nerfbake.measure_atlas_error(atlas, field, directions=fibonacci(617))
        identifiers, identify = seconds_of(lambda: nerfbake.identify_colours(field, directions=directions))
        seconds = 0.0
        if method != "grid":
            find = nerfbake.cluster_planes if method == "affine" else nerfbake.cluster_identifiers
            _, seconds = seconds_of(lambda: find(identifiers, clusters=size))
        texel = (2 if atlas.K > 256 else 1) * (method != "grid") + 3 * (method != "kmeans")
        return {
            **error._asdict(),
            "held_out": held_out.mae,
            "identify": identify,
            "cluster": seconds,
            "write": found["write"],
            "metric": metric,
            "png": sum(size for name, size in found["sizes"].items() if name.endswith(".png")),
            "gpu": atlas.image.size + texel * atlas.labels.size,
        }

    return Work(run, check)
