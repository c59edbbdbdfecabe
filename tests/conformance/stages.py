"""Stages of USD: splats, meshes and cameras in all containers, and stages of a .vdb, which OpenUSD reads here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdVol

from nerfbake import load
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.scene_variants import SceneVariant, SceneVariants
from nerfbake.scene.splats import Splats
from tests.conformance import cameras, meshes, splats, volumes
from tests.conformance.case import Case, Facts, Frozen, floats, form_named
from tests.support.usd import read_here

ENDINGS = ("usda", "usdc", "usdz")


def cases() -> Iterator[Case]:
    sh = [[dc, *rest] for dc, rest in zip(splats.DC, splats.REST, strict=True)]
    for name, up, half in (("splats", "-y", False), ("halves", "z", True)):
        facts: Facts = {**splats.PLAIN, "sh": sh, "up": up}
        scene = splats.scene_of(facts)
        made = Splats(scene.means, scene.scales, scene.quats, scene.opacity, scene.sh, True, up=up)  # type: ignore[arg-type]
        files = _files(name, "Splats", made, {"half": half}, ENDINGS if name == "splats" else ENDINGS[1:2])
        about = (
            "Two Gaussian splats in USD, in half floats but for their centres."
            if half
            else "Two Gaussian splats in USD."
        )
        yield Case(f"usd/{name}", about, files, facts, _splats, stored=1e-3 if half else 1e-6)
    told = [
        meshes.told({**meshes.SQUARE, "uvs": None}, colours=meshes.COLOURS),
        meshes.told({**meshes.TRIANGLE, "uvs": None}),
    ]
    scene_of = Meshes(tuple(map(meshes.mesh, told)))
    files = _files("meshes", "Meshes", scene_of, {"up": "z"}, ENDINGS)
    yield Case(
        "usd/meshes", "A square with colours and a triangle in USD.", files, {"meshes": told}, _meshes, stored=1e-6
    )
    own = cameras.scenes()["own"]
    files = _files("cameras", "Cameras", own, {"up": "z"}, ENDINGS)
    yield Case("usd/cameras", "Two cameras in USD.", files, cameras.facts_of(own), _cameras, stored=1e-6)
    yield _volume()
    yield _variants(made, scene_of)


def _variants(made: Splats, meshes_of: Meshes) -> Case:
    """The second splats and the meshes of the cases before, in one stage."""
    parts = SceneVariant("mesh", meshes_of, 30.5), SceneVariant("splats", made, 35.25)
    scene = SceneVariants(parts)
    files = {f"usd/variants.{end}": Frozen(form_named(end, "SceneVariants"), scene) for end in ("usda", "usdz")}
    facts = {
        "selected": "mesh",
        "variants": {part.name: {"psnr": part.psnr, "content": str(part.scene)} for part in parts},
    }
    return Case("usd/variants", "The same scene as a mesh and as splats.", files, facts, _variants_in, stored=1e-6)


def _variants_in(path: Path, _: Facts) -> Facts:
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetDefaultPrim()
    chosen = prim.GetVariantSet("representation")
    selected, found = chosen.GetVariantSelection(), {}
    for name in ("mesh", "splats"):
        assert chosen.SetVariantSelection(name)
        found[name] = dict(prim.GetCustomDataByKey("nerfbake"))
    return {"selected": selected, "variants": found}


def _files(name: str, kind: str, scene: Any, options: Facts, endings: tuple[str, ...]) -> dict[str, Frozen]:
    """The files of a scene; a crate is also a .usd, which is only read."""
    files = {f"usd/{name}.{ending}": Frozen(form_named(ending, kind), scene, options) for ending in endings}
    if len(endings) > 1:
        crate = b"".join(files[f"usd/{name}.usdc"].pieces())
        files[f"usd/{name}.usd"] = Frozen(form_named("usd", kind), None, data=crate)
    return files


def _splats(path: Path, expected: Facts) -> Facts:
    with read_here():
        return {**splats.answer(path, expected), "up": load(path, Splats).up}


def _meshes(path: Path, expected: Facts) -> Facts:
    with read_here():
        return meshes.answer(path, expected)


def _cameras(path: Path, expected: Facts) -> Facts:
    with read_here():
        return cameras.answer(path, expected)


def _volume() -> Case:
    volume = volumes.volume_of(volumes.scenes()["fog"])
    box = volume.grids[0].topology.box
    assert box is not None
    low, high = (np.asarray(end, np.float64) for end in box)
    corners = [end @ volume.transform[:, :3].T + volume.transform[:, 3] for end in (low - 0.5, high + 0.5)]
    names = [grid.name for grid in volume.grids]
    facts: Facts = {
        "up": "Z",
        "metres_per_unit": 1.0,
        "extent": floats(np.sort(np.stack(corners), axis=0)),
        "fields": {name: {"file": "./fog.vdb", "grid": name} for name in names},
    }
    files = {}
    for ending in ENDINGS[:2]:
        form = form_named(ending, "Volume")
        write: Callable[..., Any] = form.load_module().encode_files  # type: ignore[union-attr]
        (_, pieces), *_ = write(volume, "fog")
        files[f"usd/volume.{ending}"] = Frozen(form, None, data=b"".join(pieces))
    return Case("usd/volume", "A stage of a fog.vdb beside it.", files, facts, _stage, stored=1e-6)


def _stage(path: Path, _: Facts) -> Facts:
    """What OpenUSD reads: nerfbake does not read stages of volumes."""
    stage = Usd.Stage.Open(str(path))
    volume = UsdVol.Volume(stage.GetPrimAtPath("/scene/volume"))
    fields = {name: UsdVol.OpenVDBAsset(stage.GetPrimAtPath(at)) for name, at in volume.GetFieldPaths().items()}
    return {
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "metres_per_unit": UsdGeom.GetStageMetersPerUnit(stage),
        "extent": floats(np.asarray(volume.GetExtentAttr().Get(), np.float64)),
        "fields": {
            name: {"file": field.GetFilePathAttr().Get().path, "grid": str(field.GetFieldNameAttr().Get())}
            for name, field in fields.items()
        },
    }
