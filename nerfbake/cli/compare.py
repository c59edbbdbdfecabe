"""`nerfbake compare`: what one scene lost against another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import (
    BUDGET_EDGE,
    BUDGET_FRAMES,
    CAPTURE,
    Input,
    PixelSize,
    as_json,
    reads,
    speaks,
    without_effect,
)
from nerfbake.cli.words import Words


@click.command()
@reads
@click.argument("other", metavar="IN2", type=click.Path())
@click.option("--cameras", metavar="CAPTURE", help=f"The cameras: {CAPTURE}.  [default: 8 views around IN]")
@click.option("--truth", type=click.Path(), help="A folder with a photograph NAME.png for each camera.")
@click.option(
    "--size", type=PixelSize(), help="Size in pixels.  [default: the truth's or the cameras', 400x400 for an orbit]"
)
@click.option("--min-psnr", type=float, help="Exit 3 if the mean PSNR of IN2 against IN is lower (dB).")
@click.option("--max-error", type=float, help="Exit 3 if any channel of any pixel differs by more (0..1).")
@click.option(
    "--sheet",
    type=click.Path(),
    help="Write a PNG with the pictures of truth, IN and IN2, and their differences times 8.",
)
@click.option("--html", type=click.Path(), help="Write a page with budgets, figures, sizes and pictures.")
@click.option("--force", is_flag=True, help="Replace the sheet and the page if they exist.")
@as_json
@speaks
def compare(
    source: Input,
    other: str,
    cameras: str | None,
    truth: str | None,
    size: tuple[int, int] | None,
    min_psnr: float | None,
    max_error: float | None,
    sheet: str | None,
    html: str | None,
    force: bool,
    as_json: bool,
    words: Words,
) -> None:
    """Render the scenes IN and IN2 with the same cameras and print how far they are apart.

    Scenes are files of fields or meshes, and the folders of nerf2mesh's stage 1 and of its atlases.

    \b
      nerfbake compare chair.npz chair.svo.pb
      nerfbake compare chair.npz small.svo.pb --min-psnr 30 --html small.html
      nerfbake compare mesh_stage1 atlas_64 --sheet atlas.png
    """
    if not (sheet or html):
        without_effect("force", here="where nothing is written", allowed="--force with --sheet or --html")
    for target, kind in ((sheet, "Image"), (html, "Comparison")):
        if target == io.STREAM:
            raise click.UsageError("stdout has the figures; allowed for --sheet and --html: a file")
        if target:
            io.format_for(target, kind)
            io.require_absent(target, force=force)
    second = Input(other)
    fields = (nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume)
    kinds = (*fields, nerfbake.Meshes, nerfbake.Stage1, nerfbake.BakedAtlas)
    (a, facts_a), (b, facts_b) = (_read(words, each, *kinds) for each in (source, second))
    if isinstance(a, fields):
        with source.blamed(words, "building the field"):
            a = nerfbake.build_field(a)  # once, for the cameras and for the pictures
    views = source.views(words, a, cameras, size, frames=BUDGET_FRAMES, edge=BUDGET_EDGE)
    photographs = None
    if truth:
        photographs = [io.load(Path(truth) / f"{view.name}.png", nerfbake.Image) for view in views.cameras]
        if not size:
            views = nerfbake.Cameras(tuple(v.resized(*p.size) for v, p in zip(views.cameras, photographs, strict=True)))
    with second.blamed(words, f"rendering {2 * len(views.cameras)} pictures"):
        if sheet or html:
            views.require_memory(pictures=6 if truth else 4)
        found = nerfbake.compare_scenes(a, b, views, truth=photographs, keep_pictures=bool(sheet or html))
    if sheet:
        io.save(sheet, found.sheet, force=force)
    budgets: dict[str, Any] = {"min_psnr": min_psnr, "max_error": max_error}
    if html:
        io.save(html, found, force=force, a=facts_a, b=facts_b, **budgets)
    sizes = {"a": facts_a["bytes"], "b": facts_b["bytes"]}
    if as_json:
        facts = {"a": source.path, "b": other, "mean": found.means, "values": found.values, "views": found.views}
        io.print_text(json.dumps({**facts, "bytes": sizes}))
    else:
        _print(found)
        for name, size in (("IN", sizes["a"]), ("IN2", sizes["b"])):
            io.print_text(f"{'bytes':<12}{name:<14}{size:,}")
    with second.blamed(words, "judging"):
        found.require(**budgets)


def _read(words: Words, source: Input, *kinds: type) -> tuple[Any, dict[str, Any]]:
    """The scene, and what a reader wants to know of it."""
    scene, form, size = source.read_with_format(words, *kinds)
    return scene, {"name": io.reading_name(source.path), "content": str(scene), "format": form.name, "bytes": size}


def _print(found: Any) -> None:
    names = {"a_b": "IN - IN2", "a_truth": "IN - truth", "b_truth": "IN2 - truth"}
    io.print_text(f"{'view':<12}{'':<14}{'PSNR dB':>9}{'SSIM':>9}{'max error':>11}")
    rows: list[dict[str, Any]] = [*found.views, {"name": "mean", **found.means}]
    for view in rows:
        for pair, errors in view.items():
            if pair != "name":
                figures = f"{errors['psnr']:>9.2f}{errors['ssim']:>9.4f}{errors['max_error']:>11.4f}"
                io.print_text(f"{view['name']:<12}{names[pair]:<14}{figures}")
    for name, errors in found.values.items():
        io.print_text(f"{'values':<12}{name:<14}mean {errors['mean']:.4g}, max {errors['max']:.4g}")
