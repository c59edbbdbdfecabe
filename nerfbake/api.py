"""nerfbake.fit(), for Python and notebooks: fit a scene in one call, with an optional progress bar."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Literal

from nerfbake.console import Console
from nerfbake.jobs.files import AnySource
from nerfbake.jobs.steps import SILENT

if TYPE_CHECKING:
    from nerfbake.jobs.photographs import Colour
    from nerfbake.scene.n3tree import N3Tree
    from nerfbake.stages.pictures_to_views import Scenery


def fit(
    source: AnySource,
    *,
    preset: Literal["fast", "balanced", "best"] | None = None,
    minutes: float | None = None,
    epochs: str | None = None,
    resolution: int | None = None,
    samples: int = 2,
    basis: str | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    seed: int = 0,
    exposure: Literal["auto", "fit", "fixed"] = "auto",
    background: Colour | None = None,
    masks: str | None = None,
    test: str | None = None,
    holdout: int | None = None,
    scenery: Scenery = "auto",
    scale: str | None = None,
    ground: bool = False,
    device: str = "auto",
    dtype: Literal["float16", "float32"] | None = None,
    progress: bool = False,
) -> N3Tree:
    """Fit a PlenOctree to photographs, the same that `nerfbake fit` writes.

    source    a folder with photographs and cameras, or the camera file
    progress  show the progress on stderr: a bar on a terminal, a line every ten seconds elsewhere

    Every other argument is the option of `nerfbake fit` with the same name. To write a file, keep checkpoints and
    measure the quality on held-out views, call jobs.fit_file(). Raises NerfbakeError.

    >>> import nerfbake
    >>> from nerfbake import jobs
    >>> _ = jobs.write_sample_capture("photographs", frames=10, edge=32)
    >>> tree = nerfbake.fit("photographs", preset="fast", resolution=32, basis="SH1")
    >>> tree.data_format
    'SH1'
    """

    from nerfbake.jobs.fit_options import FitOptions
    from nerfbake.jobs.fits import fit_scene
    from nerfbake.jobs.photographs import PhotographOptions
    from nerfbake.jobs.world import WorldOptions

    terminal = sys.stderr is not None and sys.stderr.isatty()
    steps = Console(quiet=False, verbose=False, mode="auto" if terminal else "plain") if progress else SILENT
    options = FitOptions(
        preset=preset,
        minutes=minutes,
        epochs=epochs,
        resolution=resolution,
        samples=samples,
        basis=basis,
        box=box,
        seed=seed,
        exposure=exposure,
        device=device,
    )
    photographs = PhotographOptions(background=background, masks=masks, test=test, holdout=holdout, scenery=scenery)
    world = WorldOptions(scale=scale, ground=ground)
    return fit_scene(source, photographs=photographs, options=options, world=world, dtype=dtype, steps=steps)
