"""`nerfbake shaders`: write the shaders that read nerfbake's files."""

from __future__ import annotations

import click

from nerfbake.cli.params import console_options, max_memory
from nerfbake.cli.paths import Writes
from nerfbake.console import Console
from nerfbake.jobs.files import FolderTarget
from nerfbake.jobs.shaders import LANGUAGES, NEEDS, write_shaders


@click.command()
@click.argument("target", metavar="[OUT_DIR]", default="shaders", type=Writes())
@click.option(
    "--language",
    "languages",
    multiple=True,
    type=click.Choice(LANGUAGES),
    help="Write only this language. Repeat for more.  [default: all]",
)
@click.option(
    "--what",
    multiple=True,
    type=click.Choice(list(NEEDS)),
    help="Write only this shader and its includes. Repeat for more.  [default: all]",
)
@click.option("--force", is_flag=True, help="Replace OUT_DIR if nerfbake wrote all that it contains.")
@max_memory
@console_options
def shaders(target: str, languages: tuple[str, ...], what: tuple[str, ...], force: bool, console: Console) -> None:
    """Write shaders that read nerfbake's files.

    Writes shaders to OUT_DIR (default: shaders), with a page that explains their inputs.

    Covers octrees, VDB indices, a ray marcher, spherical harmonics, atlases and world transforms, in GLSL (ES 3.00 and
    3.30), HLSL and WGSL, with the same names in each language. NVIDIA's PNanoVDB.h reads .nvdb, in HLSL and C.

    \b
      nerfbake shaders Assets/Shaders --language hlsl --what octree --what world
    """
    write_shaders(FolderTarget(target, force), languages=languages, what=what, steps=console)
