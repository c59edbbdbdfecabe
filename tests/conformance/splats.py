"""Gaussian splats in every format: numbers that the formats hold.

gaussforge has written the .splat and the .sog, which nerfbake only reads. Their files are taken as they are frozen.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nerfbake import load
from nerfbake.formats.splat import ply as own
from nerfbake.scene.basis import SH0
from nerfbake.scene.splat_levels import SplatLevels
from nerfbake.scene.splats import Splats
from tests.conformance.case import HOME, Case, Facts, Frozen, floats, form_named
from tests.support.splats import ksplat

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


# Of .splat and .sog, which store colours of degree 0 and quaternions in bytes.
BYTES: Facts = {**PLAIN, "antialiased": False}
DC8 = [[(102 / 255 - 0.5) / SH0] * 3, [(153 / 255 - 0.5) / SH0, (51 / 255 - 0.5) / SH0, (204 / 255 - 0.5) / SH0]]
HALF = (128 / 255 * 2 - 1) / math.sqrt(2)  # no byte is 0 in a quaternion of a .sog
LEFT = math.sqrt(1 - 3 * HALF * HALF)


def cases() -> Iterator[Case]:
    ply, spz, glb = form_named("ply", "Splats"), form_named("spz"), form_named("glb", "Splats")
    for name, sh in (("sh0", [[dc] for dc in DC]), ("sh4", [[dc, *rest] for dc, rest in zip(DC, REST, strict=True)])):
        facts: Facts = {**PLAIN, "sh": sh}
        scene = scene_of(facts)
        files = {
            f"splat/{name}.ply": Frozen(ply, scene),
            # Written before .spz named their axes, and .glb had their front at +z.
            f"splat/{name}.spz": Frozen(spz, None, data=(HOME / f"splat/{name}.spz").read_bytes()),
            f"splat/{name}.glb": Frozen(glb, None, data=(HOME / f"splat/{name}.glb").read_bytes()),
            f"splat/{name}_axes.spz": Frozen(spz, scene),
            f"splat/{name}_v3.spz": Frozen(spz, scene, {"axes": "RDF", "spz_version": 3}),
            f"splat/{name}_front.glb": Frozen(glb, scene),
        }
        yield Case(f"splat/{name}", "Two Gaussian splats.", files, facts, answer, stored=1e-6)
    facts = {**BYTES, "sh": [[dc] for dc in DC8]}
    files = {"splat/rows.ksplat": Frozen(form_named("ksplat"), None, data=ksplat([scene_of(facts)], 0))}
    about = "Two Gaussian splats of a .ksplat without compression."
    yield Case("splat/rows_ksplat", about, files, facts, answer, stored=1e-6)
    above = {**facts, "sh": [[[value + 1e-5 for value in dc]] for dc in DC8]}  # it rounds colours down
    files = {"splat/rows.splat": Frozen(form_named("splat"), None, data=foreign("splat/rows.splat", above))}
    yield Case("splat/rows", "Two Gaussian splats, as gaussforge writes them.", files, facts, answer, stored=1e-6)
    sh = [[dc, *rest] for dc, rest in zip(DC8, REST, strict=True)]
    facts = {**BYTES, "sh": sh}
    data = foreign("splat/pictures.sog", facts)
    facts["quats"] = [[LEFT, HALF, HALF, HALF], [HALF, LEFT, HALF, HALF]]
    facts |= {name: facts[name][::-1] for name in NAMES}  # it sorts them by place
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    files = {
        "splat/pictures.sog": Frozen(form_named("sog"), None, data=data),
        "splat/pictures": Frozen(form_named("sog_folder"), None, data=members),
    }
    about = "Two Gaussian splats in pictures, as gaussforge writes them, and the folder of these pictures."
    yield Case("splat/pictures", about, files, facts, answer, stored=1e-6)
    quats = [[LEFT, HALF, HALF, HALF], [HALF, LEFT, HALF, HALF]]
    fine, coarse = {**BYTES, "sh": sh, "quats": quats}, {**BYTES, "sh": [[DC8[0]]], "quats": quats[:1]}
    coarse |= {name: BYTES[name][:1] for name in ("means", "scales", "opacity")}
    kind, home = form_named("sog_levels"), HOME / "splat/levels"
    members = {str(path.relative_to(home)): path.read_bytes() for path in home.rglob("*.*")}
    scene_of_levels = SplatLevels((scene_of(fine), scene_of(coarse)))
    fine |= {name: fine[name][::-1] for name in NAMES}  # they are sorted by place
    files = {"splat/levels": Frozen(kind, scene_of_levels, data=members or None)}
    yield Case("splat/levels", "Two levels of splats.", files, {"levels": [fine, coarse]}, answer_levels, stored=1e-6)


def scene_of(facts: Facts) -> Splats:
    means, scales, quats, opacity, sh = (np.array(facts[name], np.float32) for name in NAMES)
    return Splats(means, scales, quats, opacity, sh, facts["antialiased"])


def foreign(name: str, facts: Facts) -> bytes:
    """The frozen file of this name; if there is none yet, these splats as gaussforge writes them."""
    path = HOME / name
    if path.exists():
        return path.read_bytes()
    gaussforge: Any = import_module("gaussforge")  # only where a file is added, and without types
    plain = b"".join(own.encode(scene_of(facts)))
    return bytes(gaussforge.GaussForge().convert(plain, "ply", path.suffix[1:])["data"])


def answer(path: Path, _: Facts) -> Facts:
    return facts_of(load(path, Splats))


def answer_levels(path: Path, _: Facts) -> Facts:
    return {"levels": list(map(facts_of, load(path, SplatLevels).levels))}


def facts_of(found: Splats) -> Facts:
    return {**{name: floats(getattr(found, name)) for name in NAMES}, "antialiased": found.antialiased}
