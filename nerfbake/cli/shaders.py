"""`nerfbake shaders`: the shader twins as files."""

from __future__ import annotations

import click

from nerfbake.cli.params import max_memory, speaks
from nerfbake.cli.paths import Writes
from nerfbake.cli.words import Words
from nerfbake.jobs.files import FolderTarget
from nerfbake.jobs.shaders import LANGUAGES, NEEDS, write_shaders


@click.command()
@click.argument("target", metavar="[OUT_DIR]", default="shaders", type=Writes())
@click.option(
    "--language", "languages", multiple=True, type=click.Choice(LANGUAGES), help="One of them; may be repeated.  [all]"
)
@click.option("--what", multiple=True, type=click.Choice(list(NEEDS)), help="One of them; may be repeated.  [all]")
@click.option("--force", is_flag=True, help="Replace OUT_DIR and everything in it.")
@max_memory
@speaks
def shaders(target: str, languages: tuple[str, ...], what: tuple[str, ...], force: bool, words: Words) -> None:
    """Write shaders that read nerfbake's files.

    Writes them to OUT_DIR (default: shaders), with a page that says how to feed them.

    Octrees, VDB indices, a marcher, spherical harmonics, atlases and world transforms, in GLSL (ES 3.00 and 3.30), HLSL
    and WGSL, with the same names in each; and .nvdb by NVIDIA's own PNanoVDB.h, in HLSL and C.

    \b
      nerfbake shaders Assets/Shaders --language hlsl --what octree --what world
    """
    write_shaders(FolderTarget(target, force), languages=languages, what=what, steps=words)
