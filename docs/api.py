"""Writes docs/api.md: every public name with its signature, what its docstring says, and its example.

python docs/api.py                  rewrites docs/api.md
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import nerfbake
from nerfbake import jobs

PAGE = Path(__file__).with_name("api.md")
HEAD = """# API

The public names of `nerfbake` and `nerfbake.jobs`, generated from their docstrings by `make api`. [Python](python.md)
shows how to use them together. Sizes have the same letters everywhere: n nodes, m leaves, D values of a node, B basis
functions, K clusters. The tests run every example.
"""
# A heading, the package, and the modules whose names stand below it.
GROUPS: dict[str, tuple[ModuleType, str]] = {
    "Files, memory and errors": (nerfbake, "io memory errors api"),
    "Octrees": (nerfbake, "scene.n3tree scene.octree scene.quantised_octree scene.compression"),
    "Making octrees": (
        nerfbake,
        "stages.n3tree_to_octree stages.octree_to_octree stages.brick_field_to_octree stages.brick_field_to_n3tree"
        " stages.lattice_to_octree stages.vdb_to_octree stages.octree_to_compression stages.shapes_to_n3tree",
    ),
    "Radiance fields": (nerfbake, "scene.radiance_field scene.brick_field scene.function_field scene.lattice_field"),
    "Making fields": (
        nerfbake,
        "stages.scene_to_field stages.octree_to_brick_field stages.octree_to_lattice stages.lattice_to_image"
        " stages.function_to_part stages.function_to_brick_field stages.function_to_image"
        " stages.field_to_importance",
    ),
    "Cameras and photographs": (
        nerfbake,
        "scene.camera scene.views scene.held_out stages.scene_to_cameras stages.shapes_to_image"
        " stages.objects_to_image",
    ),
    "Fitting": (
        nerfbake,
        "stages.views_to_field stages.views_to_hull stages.views_to_error stages.pictures_to_views"
        " stages.field_and_views_to_views stages.brick_field_to_brick_field",
    ),
    "Volumes": (nerfbake, "scene.volume scene.vdb stages.octree_to_vdb stages.brick_field_to_vdb stages.vdb_to_vdb"),
    "Meshes and atlases": (nerfbake, "scene.mesh scene.atlas scene.stage1"),
    "Making textured meshes": (
        nerfbake,
        "stages.field_to_surface stages.mesh_to_mesh stages.views_to_vertices stages.surface_to_charts"
        " stages.views_to_texture stages.views_to_specular stages.texture_to_vertices scene.environment"
        " stages.views_and_light_to_materials stages.stage1_to_meshes",
    ),
    "Gaussian splats": (
        nerfbake,
        "scene.splats scene.splat_levels scene.scene_variants stages.splats_to_image stages.splats_to_octree"
        " stages.field_to_splats stages.views_to_splats stages.splats_to_loss stages.splats_to_splats"
        " stages.splats_to_up",
    ),
    "Baking atlases": (
        nerfbake,
        "stages.stage1_to_atlas stages.specular_to_atlas stages.specular_to_clusters stages.shapes_to_stage1"
        " stages.field_to_hull",
    ),
    "Pictures": (
        nerfbake,
        "scene.image stages.field_to_image stages.meshes_to_image stages.field_and_meshes_to_image"
        " stages.stage1_to_image",
    ),
    "Comparisons and facts": (
        nerfbake,
        "scene.comparison scene.shipment stages.scenes_to_comparison stages.scene_to_summary",
    ),
    "Pages": (
        nerfbake,
        "scene.page scene.page_splats stages.scene_to_page stages.field_to_page_field stages.n3tree_to_page_shells"
        " stages.stage1_to_page_surface stages.splats_to_page_splats",
    ),
    "Jobs: from files to files": (jobs, "jobs batch"),
}


def main() -> None:
    PAGE.write_text(page())


def page() -> str:
    """The text of docs/api.md: a list of contents, then each name below the heading of its group."""
    groups = {title: list(names_of(*group)) for title, group in GROUPS.items()}
    listed = [name for package, name in chain.from_iterable(groups.values())]
    missing = {*nerfbake.__all__, *jobs.__all__} - {*listed, "jobs"}  # type: ignore[attr-defined]
    if missing:
        raise SystemExit(f"docs/api.py has no group for {', '.join(sorted(missing))}")
    parts = [HEAD, *(contents(title, names) for title, names in groups.items()), ""]
    for title, names in groups.items():
        parts.append(f"## {title}\n")
        for package, name in names:
            thing = getattr(package, name)
            text = blocks(inspect.getdoc(thing) or "")
            parts += [f"### {name}\n", f"```py\n{signature(name, thing)}\n```\n", *text]
    return "\n".join(parts)


def names_of(package: ModuleType, modules: str) -> Iterator[tuple[ModuleType, str]]:
    """The names that a package exports from these modules, classes first."""
    homes = tuple(f"nerfbake.{module}" for module in modules.split())
    found = {name: getattr(package, name) for name in package.__all__ if getattr(package, name) is not jobs}
    for name in sorted(found, key=lambda name: (not inspect.isclass(found[name]), name)):
        home = found[name].__module__
        if any(home == each or home.startswith(f"{each}.") for each in homes):
            yield package, name


def contents(title: str, names: list[tuple[ModuleType, str]]) -> str:
    """One entry of the list of contents."""
    links = ", ".join(f"[`{name}`](#{name.lower()})" for _, name in names)
    return f"- [{title}](#{re.sub(r'[^a-z0-9 -]', '', title.lower()).replace(' ', '-')}): {links}"


def signature(name: str, thing: Callable[..., Any]) -> str:
    """As a reader would type it, a parameter a line where it is long."""
    if inspect.isclass(thing) and issubclass(thing, Exception):
        return f"class {name}(Exception)"
    parameters, starred = [], False
    for each in inspect.signature(thing).parameters.values():
        if each.kind is each.KEYWORD_ONLY and not starred:
            parameters.append("*")
        starred = starred or each.kind in (each.KEYWORD_ONLY, each.VAR_POSITIONAL)
        stars = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        default = "" if each.default is each.empty else f" = {_shown(each.default)}"
        annotation = getattr(each.annotation, "__forward_arg__", each.annotation)  # as named tuples hold them
        parameters.append(f"{stars}{each.name}: {annotation}{default}")
    line = f"{name}({', '.join(parameters)})"
    if len(line) > 100:
        line = f"{name}(\n    " + ",\n    ".join(parameters) + ",\n)"
    result = inspect.signature(thing).return_annotation
    return line if inspect.isclass(thing) else f"{line} -> {result}"


def _shown(default: Any) -> str:
    """A default as one would type it; what a dataclass makes anew for each object has no such spelling."""
    return repr(default) if isinstance(default, str | int | float | tuple | None) else "..."


def blocks(text: str) -> Iterator[str]:
    """A docstring's paragraphs: examples as code, columns as they stand, everything else as prose."""
    for paragraph in text.split("\n\n"):
        if paragraph.lstrip().startswith(">>>"):
            yield f"```pycon\n{inspect.cleandoc(paragraph)}\n```\n"
        elif re.search(r"^\s|\S {2,}\S", paragraph, re.MULTILINE):
            yield f"```text\n{paragraph.rstrip()}\n```\n"
        else:
            yield re.sub(r"([*_<|])", r"\\\1", paragraph) + "\n"


if __name__ == "__main__":
    main()
