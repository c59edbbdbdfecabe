"""What Python and notebooks get of the command line: one call that fits, with a bar if that is asked for."""

from __future__ import annotations

import sys
from typing import Literal

import nerfbake
from nerfbake.cli.words import Words
from nerfbake.jobs.files import AnySource
from nerfbake.jobs.fits import Recipe, fit_scene
from nerfbake.jobs.photographs import Album, Colour
from nerfbake.jobs.steps import SILENT


def fit(
    source: AnySource,
    *,
    preset: Literal["fast", "balanced", "best"] | None = None,
    minutes: float | None = None,
    epochs: str | None = None,
    resolution: int = 256,
    samples: int = 2,
    basis: str = "SH9",
    box: tuple[float, float, float, float, float, float] | None = None,
    seed: int = 0,
    background: Colour | None = None,
    masks: str | None = None,
    test: str | None = None,
    holdout: int | None = None,
    dtype: Literal["float16", "float32"] | None = None,
    progress: bool = False,
) -> nerfbake.N3Tree:
    """The PlenOctree that `nerfbake fit` would write; every argument is the option of the same name.

    source: a folder of photographs and cameras, or the cameras' file. progress: say on stderr what is done, with a bar
    on a terminal and a line every ten seconds elsewhere. jobs.fit_file() writes a file, keeps checkpoints and judges.
    Raises NerfbakeError.

    >>> import nerfbake
    >>> from nerfbake import jobs
    >>> _ = jobs.write_sample_capture("photographs", frames=10, edge=32)
    >>> tree = nerfbake.fit("photographs", preset="fast", resolution=32, basis="SH1")
    >>> tree.data_format
    'SH1'
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    steps = Words(quiet=False, verbose=False, mode="auto" if terminal else "plain") if progress else SILENT
    recipe = Recipe(preset, minutes, epochs, resolution, samples, basis, box, seed)
    album = Album(background, masks, test, holdout)
    return fit_scene(source, album=album, recipe=recipe, dtype=dtype, steps=steps)
