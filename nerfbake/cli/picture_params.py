"""Options of the pictures that a scene is fitted to: photographs, or pictures of another scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import click

from nerfbake.cli.params import CAPTURE, Command, Number, bundled, device_option, without_effect
from nerfbake.cli.paths import PhotographsPath, Reads
from nerfbake.cli.render import Background

if TYPE_CHECKING:
    from nerfbake.jobs.fitted_pictures import FittedPictures


class FitBackground(Background):
    """auto, white, black, or R,G,B in 0..255."""

    known: ClassVar = {"auto": None, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


photograph_options = bundled(
    "photographs",
    "jobs.photographs.PhotographOptions",
    click.option(
        "--background",
        type=FitBackground(),
        default="auto",
        show_default=True,
        help="Background behind the object: white, black or R,G,B. auto: white for pictures with alpha, else the "
        "colour at the edges of the pictures.",
    ),
    click.option(
        "--masks",
        metavar="DIR",
        type=Reads(),
        help="Folder with a mask NAME.png for each picture: white where the object is, or with scenery what is fitted.",
    ),
    click.option(
        "--test",
        metavar="CAPTURE",
        type=PhotographsPath(readable=False),
        help="Other cameras, with the held-out views on which the result is measured.",
    ),
    click.option(
        "--holdout",
        metavar="N",
        type=click.IntRange(min=2),
        help="Hold out every N-th view to measure the result.  [default: 8; none if the capture has test views]",
    ),
)


def require_photographs(views: str | None) -> None:
    """Raise click.UsageError for photograph_options without --views."""
    if views is None:
        allowed = "it with --views"
        without_effect("background", "masks", "test", "holdout", here="without --views", allowed=allowed)


def rendered_options(
    condition: str, scene: str, *, frames: int | None = 100
) -> tuple[Callable[[Command], Command], ...]:
    """Return --frames and --edge, the pictures of this scene to render. condition: when they have an effect.

    frames: how many by default; None: the job decides, see FittedPictures.
    """
    default = "" if frames else "  [default: 100; 50 for a mesh of a scene with scenery]"
    number = click.option(
        "--frames",
        type=click.IntRange(2, 1000),
        default=frames,
        show_default=frames is not None,
        help=f"{condition}: number of pictures of {scene}.{default}",
    )
    edge = click.option(
        "--edge",
        type=click.IntRange(8, 4096),
        default=400,
        show_default=True,
        help=f"{condition}: width and height of these pictures, in pixels.",
    )
    return number, edge


def _check_pictures(pictures: FittedPictures) -> None:
    require_photographs(pictures.views)
    if pictures.views is not None:
        without_effect("frames", "edge", here="with --views", allowed="--frames and --edge without --views")


def training_picture_options(fitted: str, kind: str) -> Callable[[Command], Command]:
    """Add --views with photograph_options, --frames, --edge and --device; pass the command `pictures`.

    fitted: what the photographs of --views are, for the help. kind: the class of `pictures`, as for bundled().
    """
    return bundled(
        "pictures",
        kind,
        click.option(
            "--views",
            metavar="CAPTURE",
            type=PhotographsPath(),
            help=f"{fitted}: {CAPTURE}.  [default: pictures of IN, from all sides]",
        ),
        *rendered_options("Without --views", "IN to render", frames=None),
        device_option,
        photograph_options,
        check=_check_pictures,
    )


ray_samples = click.option(
    "--samples",
    type=click.IntRange(1, 2),
    default=2,
    show_default=True,
    help="Rays along each edge of a pixel. Choose the value that OUT will be rendered with: 2 for photographs, "
    "whose pixels are averages.",
)
held_out_psnr = click.option(
    "--min-psnr",
    type=Number(),
    help="Lowest allowed PSNR of OUT on the held-out views in dB. Below it, OUT is renamed to OUT.rejected (exit code "
    "3).",
)
