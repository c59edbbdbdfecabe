"""`nerfbake info`: what a file is."""

from __future__ import annotations

import json
from typing import Any

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import Input, as_json, reads, speaks
from nerfbake.cli.words import Words
from nerfbake.errors import format_size


@click.command()
@reads
@as_json
@speaks
def info(source: Input, as_json: bool, words: Words) -> None:
    """Print what IN is: kind, basis, resolution, nodes and leaves by level, world box, value ranges, sizes.

    Of folders of nerf2mesh's stage 1 and of atlases: textures, MLP, maps, clusters, errors. Of cameras: dialect, how
    many, picture sizes, focal lengths, lenses, where they stand and what is up. Of pictures and depth: size, what is
    opaque or met.

    \b
      nerfbake info chair.npz
      nerfbake info chair.svo.pb --json | jq .nodes
      nerfbake info atlas_64 --json | jq '.cascades[].errors.mae'
    """
    scene, form, size = source.read_with_format(words)
    facts = {"file": source.path, "format": form.name, "bytes_on_disk": size, **nerfbake.summarise_scene(scene)}
    if as_json:
        io.print_text(json.dumps(facts))
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
