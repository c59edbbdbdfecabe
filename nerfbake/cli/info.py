"""`nerfbake info`: what a file is."""

from __future__ import annotations

from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import as_json, reads, speaks
from nerfbake.cli.words import Words
from nerfbake.errors import format_size
from nerfbake.jobs.descriptions import describe_file
from nerfbake.jobs.files import Source


@click.command()
@reads
@as_json
@speaks
def info(source: Source, as_json: bool, words: Words) -> None:
    """Describe a file or folder.

    Prints kind, basis, resolution, nodes and leaves by level, world box, value ranges and sizes of IN.

    For a stage-1 folder of nerf2mesh or an atlas it prints textures, MLP, maps, clusters and errors. For cameras it
    prints their dialect, number, picture sizes, focal lengths, lenses, places and the axis that points up. For
    meshes it prints their triangles, how many pieces these make, and whether the surface is closed. For a picture or a
    depth it prints the size and how much is opaque, or met by a ray.

    \b
      nerfbake info chair.npz
      nerfbake info chair.svo.pb --json | jq .nodes
      nerfbake info atlas_64 --json | jq '.cascades[].errors.mae'
    """
    facts = describe_file(source, steps=words)
    if as_json:
        io.print_json(facts)
        return
    _table(facts)


def _table(facts: dict[str, Any]) -> None:
    for name, value in facts.items():
        if name in ("grids", "cascades"):
            for part, parts in value.items():
                io.print_text(f"\n{name[:-1]} {part}")
                _table(parts)
            io.print_text()
        else:
            io.print_text(f"{name.replace('_', ' '):<20}{_text(name, value)}")


def _text(name: str, value: Any) -> str:
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,} ({format_size(value)})" if name.startswith("bytes") else f"{value:,}"
        case dict():
            return ", ".join(f"{key} {_text(key, part)}" for key, part in value.items())
        case [float(), *_]:
            return f"[{', '.join(f'{part:.6g}' for part in value)}]"
        case list():
            return (" x " if name == "resolution" else ", ").join(_text("", part) for part in value)
        case _:
            return str(value)
