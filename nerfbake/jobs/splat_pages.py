"""Write web pages that draw splats as splats."""

from __future__ import annotations

import threading
from dataclasses import replace

from nerfbake import catalog, io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import Budget, judge_output
from nerfbake.jobs.devices import DEVICE, renderer_on
from nerfbake.jobs.files import AnySource, AnyTarget, Source, as_source
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.pages import Colour, read_previews, written_or_opened
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.splats import SplatsOptions, SplatsViews, splats_of_field
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.upright import upside_down_note
from nerfbake.jobs.views import orbit_psnr, page_views
from nerfbake.scene.camera import Cameras
from nerfbake.scene.origin import lost_origin
from nerfbake.scene.page import Page
from nerfbake.scene.splats import UPS, Splats, Up
from nerfbake.stages.renderers import Renderer
from nerfbake.stages.splats_to_page_splats import build_page_splats
from nerfbake.stages.views_to_error import measure_views

_FRAMES, _EDGE = 4, 400  # number and edge of the pictures on which the loss of rounding is measured


def view_splats(
    source: AnySource,
    target: AnyTarget | None = None,
    *,
    functions: FunctionVoxels = FunctionVoxels(),
    cameras: str | None = None,
    photographs: bool = False,
    min_psnr: float | None = None,
    title: str | None = None,
    background: Colour | None = None,
    device: str = DEVICE,
    steps: Steps = SILENT,
) -> Page:
    """Write a page that draws splats in any browser, and return it. This is `nerfbake view --as splats`.

    The scene is splats, or any scene with a field, to which splats are fitted as by bake_splats(). Its world is kept,
    so that cameras copied from the page are those of `nerfbake render`. Up is the axis that the file states; else that
    next to the cameras' mean up; without cameras -y. The other arguments are those of view_file(); min_psnr is the
    lowest allowed mean PSNR of the page against the splats. Raises NerfbakeError.

    >>> page = view_splats("a.ply", "splats.html", min_psnr=45)
    >>> page.content.n <= 400
    True
    """
    source = as_source(source)
    budget = Budget(min_psnr=min_psnr, cameras=cameras, device=device)
    if photographs and cameras is None:
        raise UsageError("`photographs` needs `cameras`, the capture that they are read from")
    with written_or_opened(target) as file:
        file.require("Page")
        budget.require(file)
        render = renderer_on(device, steps=steps)
        splats = _read(steps, source, functions, render)
        views, first = page_views(steps, splats, cameras, name=source.name)
        if splats.up is None and cameras is not None:
            splats = replace(splats, up=_up_of(views))
        previews: tuple[bytes, ...] = ()
        if photographs:
            views, previews = read_previews(steps, str(cameras), views)
        with source.blamed(steps, "rounding the splats"):
            content = build_page_splats(splats)
            decibels = orbit_psnr(splats, content.restored(), _FRAMES, _EDGE, render)
        steps.say(f"{source.name}: rounded for the page, {decibels:.2f} dB against {_FRAMES} pictures of the splats")
        with source.blamed(steps, "rendering the cover"):
            cover = render(splats, first, background=background)
        named = catalog.scene_name(source.name) if title is None else title
        turns = cameras is None
        made = Page(content, None, views, cover, named, turns=turns, background=background, photographs=previews)
        with file.writing(steps, made) as written:
            judge_output(
                written.path, splats, budget, made_from=source.name, name=file.path, read=_splats_of, steps=steps
            )
    return made


def _read(steps: Steps, source: Source, functions: FunctionVoxels, render: Renderer) -> Splats:
    """Return the splats of a source, or splats fitted to its field."""
    reading = Reading(steps, source, functions=functions)
    reading.require()
    if isinstance(reading.scene, Splats):
        splats = reading.scene
        if note := upside_down_note(splats):
            steps.say(f"{source.name}: {note}")
        if splats.origin.any():
            steps.say(f"{source.name}: {lost_origin(splats.origin, 'a page')}")
        return splats
    reading.use_inner_cube()
    field = reading.field(visible="nothing to fit splats to")
    pictures = SplatsViews()
    split = pictures.split(steps, source, field, render)
    splats = splats_of_field(steps, source, field, split, pictures, SplatsOptions(), threading.Event())
    with source.blamed(steps, "measuring the splats"):
        views = measure_views(splats, split.held_out, render=render)
    psnr = sum(view.psnr for view in views) / len(views)
    steps.say(f"{source.name}: {splats}, {psnr:.2f} dB on {split.held_out}")
    return replace(splats, up="z")  # as in all scenes but splats


def _up_of(cameras: Cameras) -> Up:
    """Return the axis that is next to the cameras' mean up."""
    total = [sum(float(camera.pose[row, 1]) for camera in cameras.cameras) for row in range(3)]
    axis = max(range(3), key=lambda row: abs(total[row]))
    return UPS[2 * axis + int(total[axis] < 0)]


def _splats_of(path: str) -> Splats:
    """Read the splats of a written page, with the values that its shader gets."""
    found: Splats = io.load_page_content(path).restored()
    return found
