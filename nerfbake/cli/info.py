"""`nerfbake info`: describe a file or a folder."""

from __future__ import annotations

from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import as_json, console_options, max_memory
from nerfbake.cli.paths import Reads
from nerfbake.console import LONGEST_TOLD, Console
from nerfbake.errors import for_shell, format_size, one_line
from nerfbake.jobs.files import Source


@click.command()
@click.argument("source", metavar="[IN]", required=False, type=Reads(allow_dash=True))
@click.option("--devices", is_flag=True, help="List the graphics adapters of this machine instead.")
@as_json
@max_memory
@console_options
def info(source: str | None, devices: bool, as_json: bool, console: Console) -> None:
    """Describe a file, a folder or graphics cards.

    Prints the kind, basis, resolution, nodes and leaves per level, world box, value ranges and sizes of IN.

    For a stage-1 folder of nerf2mesh or an atlas, prints textures, MLP, maps, clusters and errors. For cameras, prints
    dialect, count, picture sizes, focal lengths, lenses, positions and up axis. For meshes, prints the number of
    triangles and connected pieces, and whether the surface is closed. For a picture or a depth map, prints the size and
    the share of pixels that are opaque or hit by a ray.

    \b
      nerfbake info chair.npz
      nerfbake info chair.svo.pb --json | jq .nodes
      nerfbake info atlas_64 --json | jq '.cascades[].errors.mae'
      nerfbake info --devices
    """

    if devices:
        if source is not None:
            raise click.UsageError("--devices describes no file; allowed: IN or --devices")
        _print_devices(as_json)
        return
    if source is None:
        raise click.UsageError("Missing argument 'IN'; allowed: a file or folder, or --devices")

    from nerfbake.jobs.descriptions import describe_file

    facts = describe_file(Source(source), steps=console)
    if as_json:
        io.print_json(facts)
        return
    _table(facts)


def _print_devices(as_json: bool) -> None:
    from nerfbake.jobs.devices import describe_devices, missing_library

    found = describe_devices()
    if as_json:
        io.print_json({"devices": found})
        return
    for device in found:
        name = one_line(device["name"])
        chosen = "by default" if device["default"] else f"with --device '{name}'"
        io.print_text(name)
        io.print_text(f"  {device['kind']}, {device['backend']}, {one_line(device['driver'])}")
        size = format_size(device["bytes_of_buffer"])
        io.print_text(f"  renders fields of up to {device['cells']:,} cells with SH9 (buffers of {size})")
        slow = "; it computes on the CPU, slower than nerfbake itself" if device["kind"] == "software" else ""
        io.print_text(f"  used {chosen}{slow}")
    if not found:
        missing = missing_library()
        io.print_text("no graphics adapter" + (f"; to look for one: {missing}" if missing else ""))


def _table(facts: dict[str, Any]) -> None:
    for name, value in facts.items():
        if name in ("grids", "cascades"):
            for part, parts in value.items():
                io.print_text(f"\n{name[:-1]} {one_line(part)}")
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
            return ", ".join(f"{one_line(str(key))} {_text(key, part)}" for key, part in value.items())
        case [float(), *_]:
            return f"[{', '.join(map(_short, value))}]"
        case list():
            return (" x " if name == "resolution" else ", ").join(_text("", part) for part in value)
        case _:
            return one_line(for_shell(str(value)), LONGEST_TOLD)


def _short(number: float) -> str:
    """Six digits, or all before the point and three behind it: coordinates of a map have more."""
    return f"{number:.6g}" if not 1e5 <= abs(number) < 1e10 else f"{number:.3f}".rstrip("0").rstrip(".")
