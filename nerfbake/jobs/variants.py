"""Write the same scene as splats, as a mesh and as a volume in one stage of USD."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from nerfbake import catalog, io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.mesh_options import MeshFile, MeshOptions, MeshViews
from nerfbake.jobs.meshes import bake_mesh
from nerfbake.jobs.octrees import bake_volume
from nerfbake.jobs.splats import SplatsOptions, SplatsViews, bake_splats
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.scene_variants import REPRESENTATIONS, Representation, SceneVariant, SceneVariants
from nerfbake.scene.splats import Splats

_ANY = 0.0  # dB: a limit that every picture reaches, so that the volume is measured


@dataclass(frozen=True, kw_only=True)
class VariantOptions:
    """How each representation is made: as by bake_splats() and bake_mesh(), by default with their defaults."""

    splats: SplatsOptions = SplatsOptions()
    splats_views: SplatsViews = SplatsViews()
    mesh: MeshOptions = MeshOptions()
    mesh_views: MeshViews = MeshViews()


def bake_variants(
    source: AnySource,
    target: AnyTarget,
    names: Sequence[str],
    *,
    options: VariantOptions = VariantOptions(),
    functions: FunctionVoxels = FunctionVoxels(),
    steps: Steps = SILENT,
) -> SceneVariants:
    """Write a scene in several representations as one stage, and return them. This is `nerfbake convert --variants`.

    Reads `source` as bake_splats(), bake_mesh() and bake_volume() do. Writes `target`, a stage of USD whose default
    prim has a variant for each of `names`: splats, mesh and volume, the first of which is selected. Each has the mean
    PSNR of its pictures against those of the scene in its metadata. A package cannot contain a volume; beside text the
    grids are a .vdb. Raises NerfbakeError.

    >>> small = VariantOptions(
    ...     splats=SplatsOptions(splats=200, epochs=1),
    ...     splats_views=SplatsViews(frames=4, edge=32),
    ...     mesh=MeshOptions(triangles=(200,), texture=32),
    ...     mesh_views=MeshViews(frames=4, edge=32),
    ... )
    >>> made = bake_variants("a.npz", "variants.usdz", ["splats", "mesh"], options=small)
    >>> [variant.name for variant in made.variants]
    ['splats', 'mesh']
    """
    source, target = as_source(source), as_target(target)
    _require(source, target, names)
    with tempfile.TemporaryDirectory(prefix="nerfbake-") as folder:
        made = []
        for name in names:
            place = str(Path(folder) / name)
            made.append(_made(steps, source, place, cast(Representation, name), options, functions))
        scene = SceneVariants(tuple(made))
        target.write(steps, scene)
    for variant in made:
        steps.say(f"{target.name}: {variant.name}: {variant.psnr:.2f} dB against {source.name}")
    return scene


def _require(source: Source, target: Target, names: Sequence[str]) -> None:
    """Raise NerfbakeError for what cannot be written. Call it before doing any work."""
    known = ", ".join(REPRESENTATIONS)
    if not names or len(set(names)) < len(names) or not set(names) <= set(REPRESENTATIONS):
        raise UsageError(f"`variants` are {','.join(names)[:80]!r}; allowed: some of {known}, each once")
    if source.path == io.STREAM:
        raise UsageError("`variants` read IN several times; allowed: a file")
    form = target.require("SceneVariants")
    if "volume" in names:
        target.require_measurable("a volume needs a file beside the stage")
        if not form.spread:
            others = ", ".join(each.suffix for each in catalog.formats_of("SceneVariants") if each.spread)
            raise UsageError(f"a {form.suffix} cannot contain a volume; allowed: `variants` without it, or {others}")


def _made(
    steps: Steps, source: Source, place: str, name: Representation, options: VariantOptions, functions: FunctionVoxels
) -> SceneVariant:
    """Make a representation in a file at `place`, which has every number of it, and return it with its loss."""
    path = place + _suffix_of(name)
    psnrs: list[float] = []
    if name == "splats":
        views = options.splats_views
        made = bake_splats(source, path, views, options=options.splats, functions=functions, steps=steps)
        splats = io.load(path, Splats)
        if made.up is not None:  # USD stores them unturned
            splats = replace(splats.without_up(made.up), up=made.up)
        return SceneVariant(name, splats, made.psnr)
    if name == "mesh":
        file, pictures = MeshFile(image="png"), options.mesh_views
        mesh = bake_mesh(
            source, path, pictures=pictures, options=options.mesh, file=file, functions=functions, steps=steps
        )
        psnrs.append(mesh.quality.psnr)
    else:
        budget = Budget(min_psnr=_ANY)
        bake_volume(source, path, up="y", functions=functions, budget=budget, steps=steps, report=psnrs.append)
    return SceneVariant(name, io.load(path, REPRESENTATIONS[name]), psnrs[0])


def _suffix_of(name: Representation) -> str:
    """The extension of a format that stores all of a representation, and that is read without a further library."""
    forms = [form for form in catalog.formats_of(REPRESENTATIONS[name].__name__) if form.readable and not form.library]
    if name == "splats":
        return next(form.suffix for form in forms if form.load_splat_module().KEEPS_ORIGIN)
    if name == "mesh":  # in the axes of the field
        return next(form.suffix for form in forms if form.choices("image") and not form.choices("up"))
    beside = [ending for form in catalog.formats_of("SceneVariants") for ending in form.spread]
    return next(form.suffix for form in forms if form.suffix in beside)
