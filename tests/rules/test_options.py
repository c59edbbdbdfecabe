"""Options of commands, jobs and stages agree: names, allowed values and defaults."""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

import click
import pytest

from nerfbake import jobs
from nerfbake.cli.main import cli
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages.field_to_image import RenderOptions, render_field
from nerfbake.stages.n3tree_to_octree import Resample
from nerfbake.stages.octree_to_lattice import LatticeOptions, build_lattice
from nerfbake.stages.specular_to_atlas import AtlasOptions, bake_atlas

# Types that jobs import for annotations only.
ANNOTATIONS = {"LatticeOptions": LatticeOptions, "RadianceField": RadianceField, "Resample": Resample}

TYPED: dict[Any, Callable[..., Any]] = {
    AtlasOptions: bake_atlas,
    LatticeOptions: build_lattice,
    RenderOptions: render_field,
}
JOBS: dict[str, Callable[..., Any]] = {
    "atlas": jobs.bake_atlas_folder,
    "atlas-error": jobs.measure_atlas,
    "compress": jobs.compress_file,
    "convert": jobs.convert_file,
    "frames": jobs.take_frames,
    "hull": jobs.bake_hull,
    "lattice": jobs.bake_lattice,
    "lod": jobs.bake_lod,
    "poses": jobs.find_poses,
    "refit": jobs.refit_file,
    "render": jobs.render_views,
    "sample capture": jobs.write_sample_capture,
    "sample nerf2mesh": jobs.write_sample_stage1,
    "sample octree": jobs.write_sample_n3tree,
    "svo": jobs.bake_octree,
    "vdb": jobs.bake_volume,
    "view": jobs.view_file,
}
# Arguments that a command builds from several options, or does not offer.
COMPOSED = {
    "budget",
    "choice",
    "data",
    "functions",
    "goal",
    "look",
    "mesh",
    "options",
    "photographs",
    "report",
    "splats",
    "world",
    "steps",
}
# Options that a command passes to its job in another form, or only under a condition.
CONVERTED = {"background", "no_child"}


def options_of(function: Callable[..., Any]) -> dict[str, tuple[Any, Any]]:
    """{name: (type, default)} of each keyword. Options of a TypedDict get the defaults of their stage."""
    hints, found = get_type_hints(function, localns=ANNOTATIONS), {}
    for name, each in inspect.signature(function).parameters.items():
        if each.kind is each.KEYWORD_ONLY:
            found[name] = hints[name], each.default
        elif each.kind is each.VAR_KEYWORD:
            (typed,) = get_args(hints[name])
            assert is_typeddict(typed), f"{function.__name__} takes options without types"
            stage = inspect.signature(TYPED[typed]).parameters
            found |= {key: (hint, stage[key].default) for key, hint in get_type_hints(typed).items()}
    return found


def values_of(hint: Any) -> set[Any]:
    """The values of a Literal, also inside a union; empty for other types."""
    if get_origin(hint) is Literal:
        return set(get_args(hint))
    return set().union(*map(values_of, get_args(hint))) if get_origin(hint) in (Union, types.UnionType) else set()


@pytest.mark.parametrize("typed", TYPED, ids=lambda typed: str(typed.__name__))
def test_typed_options_are_those_of_their_stage(typed: Any) -> None:
    hints = get_type_hints(TYPED[typed])
    for name, hint in get_type_hints(typed).items():
        assert hints[name] == hint, name


@pytest.mark.parametrize("name", JOBS)
def test_a_command_offers_what_its_job_takes(name: str) -> None:
    group, _, sub = name.partition(" ")
    command: Any = cli.commands[group]
    command = command.commands[sub] if sub else command
    given = {param.name: param for param in command.params}
    for option, (hint, default) in options_of(JOBS[name]).items():
        if option in COMPOSED:
            continue
        param = given[option]
        if isinstance(param.type, click.Choice) and option not in CONVERTED and values_of(hint):
            assert set(param.type.choices) == values_of(hint), option
        if option not in CONVERTED:
            shown = param.to_info_dict()["default"]
            assert shown is None or isinstance(param, click.Argument) or shown == default, option


def test_no_job_and_no_stage_takes_options_without_types() -> None:
    for name in JOBS:
        options_of(JOBS[name])
