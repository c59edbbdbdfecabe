"""Gaussian splats as .ply and .spz: numbers that both formats hold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerfbake import load
from nerfbake.scene.splats import Splats
from tests.conformance.case import Case, Facts, Frozen, floats, form_named

NAMES = ("means", "scales", "quats", "opacity", "sh")
# Scales of e^(k/16 - 10), quaternions about one axis, and coefficients of k/128 are exact in .spz but for rounding.
PLAIN: Facts = {
    "means": [[0.5, -1.25, 2.0], [-3.0, 0.125, 0.0]],
    "scales": [[math.exp(-4), math.exp(-3.5), math.exp(-2)], [math.exp(-5), math.exp(-5), math.exp(-4.75)]],
    "quats": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]],
    "opacity": [51 / 255, 204 / 255],
    "antialiased": True,
}
DC = [[(102 / 255 - 0.5) / 0.15] * 3, [(153 / 255 - 0.5) / 0.15, (51 / 255 - 0.5) / 0.15, (204 / 255 - 0.5) / 0.15]]
REST = [[[0.5, 0.25, -0.125], [-0.5, 0.0, 0.75], [0.0625, 0.0, -0.25]], [[0.25] * 3, [-0.25] * 3, [0.0] * 3]]


def cases() -> Iterator[Case]:
    ply, spz = form_named("ply", "Splats"), form_named("spz")
    for name, sh in (("sh0", [[dc] for dc in DC]), ("sh4", [[dc, *rest] for dc, rest in zip(DC, REST, strict=True)])):
        facts: Facts = {**PLAIN, "sh": sh}
        means, scales, quats, opacity, colours = (np.array(facts[name], np.float32) for name in NAMES)
        scene = Splats(means, scales, quats, opacity, colours, antialiased=True)
        files = {f"splat/{name}.ply": Frozen(ply, scene), f"splat/{name}.spz": Frozen(spz, scene)}
        yield Case(f"splat/{name}", "Two Gaussian splats.", files, facts, answer, stored=1e-6)


def answer(path: Path, _: Facts) -> Facts:
    found = load(path, Splats)
    return {**{name: floats(getattr(found, name)) for name in NAMES}, "antialiased": found.antialiased}
