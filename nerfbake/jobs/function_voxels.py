"""Trained fields: which part of them is baked, and what is lost. readings.py uses bake_field() for all jobs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.jobs.steps import Steps
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.views import world_box

RESOLUTION = 256  # cells along an edge, by default
_VIEWS, _EDGE = 4, 64  # number and edge of the pictures on which the loss is measured
_MANY = 40  # cameras, from which on those of these pictures are held back; of 24, holding back 4 costs 0.15 dB

World = Literal["original", "trained"]


@dataclass(frozen=True, kw_only=True)
class FunctionVoxels:
    """How a trained field becomes voxels.

    resolution  cells along each edge of the box or inner cube, a power of two; None: 256
    box         two opposite corners x0, y0, z0, x1, y1, z1 of what is baked; all: the box in which the field is
                defined, of a contracted one its inner cube; None: what the cameras see
    basis       SH basis of the colours; None: SH9, or that of a network that computes spherical harmonics itself
    scenery     also bake what is around the inner cube; None: if much of the light comes from there
    world       original: that of the user's cameras; trained: that of the network
    seen_from   a capture with the cameras that the voxels are seen from, in that world; None: those that the field was
                trained with, or else cameras all around it
    """

    resolution: int | None = None
    box: tuple[float, ...] | Literal["all"] | None = None
    basis: str | None = None
    scenery: bool | None = None
    world: World = "original"
    seen_from: str | None = None

    @property
    def given(self) -> set[str]:
        """The options that are not the default."""
        default = vars(FunctionVoxels())
        return {name for name, value in vars(self).items() if value != default[name]}

    def with_others(
        self, options: ReadingOptions, resolution: int | tuple[int, int, int] | None = None
    ) -> FunctionVoxels:
        """Return these options with those that a command has for all scenes, where they are given.

        Raises UsageError if the resolution differs between the axes.
        """
        edges = {resolution} if isinstance(resolution, int) else set(resolution or ())
        if len(edges) > 1:
            text = "a trained field has as many cells along each axis"
            raise UsageError(f"{text}; allowed: one number as `resolution`")
        return replace(
            self,
            resolution=min(edges, default=self.resolution),
            box=self.box if options.box == "inner" else options.box,
            basis=options.basis or self.basis,
        )

    def placed(self, field: FunctionField) -> FunctionField:
        """Return the field in the chosen world."""
        return field.in_trained_world() if self.world == "trained" else field


def bake_field(
    steps: Steps,
    source: Source,
    field: FunctionField,
    options: FunctionVoxels,
    sigma_min: float | None = None,
) -> tuple[N3Tree, FunctionField]:
    """Bake a field to a PlenOctree, and print what was baked and what is lost.

    Returns the tree, and the field that it is compared with: its background is the colour of the last sample only if
    the tree has scenery.
    """
    from nerfbake.jobs.views import read_cameras
    from nerfbake.stages.brick_field_to_n3tree import build_n3tree
    from nerfbake.stages.function_to_brick_field import bake_function
    from nerfbake.stages.function_to_image import measure_function
    from nerfbake.stages.function_to_part import cameras_of, identify_function_part
    from nerfbake.stages.scene_to_field import build_field_from_n3tree

    cameras = None if options.seen_from is None else read_cameras(steps, options.seen_from)
    if cameras is None and field.cameras is None:
        steps.say(f"{source.name}: has no cameras, and is baked as seen from all around; `seen_from` gives cameras")
    box = None
    if options.box is not None:
        box = field.world_box if options.box == "all" else world_box(options.box)
    with source.blamed(steps, "looking for what the cameras see"):
        field.require_usable()
        cameras = cameras or cameras_of(field)
        with io.blame(options.seen_from or source.name):
            cameras.require_covered()
        views = cameras.few(_VIEWS, _EDGE)
        if len(cameras.cameras) >= _MANY:
            names = set(views.names)
            rest = tuple(camera for camera in cameras.cameras if camera.name not in names)
            cameras = replace(cameras, cameras=rest) if len(rest) >= _MANY - _VIEWS else cameras
        field = replace(field, cameras=cameras)
        chosen = identify_function_part(field, cameras, box=box, scenery=options.scenery)
    told = "the box" if chosen.shells == 1 else "the inner cube"
    ends = " to ".join(", ".join(f"{value:.4g}" for value in corner) for corner in chosen.box.tolist())
    why = "" if chosen.outside is None else f": {chosen.outside:.1%} of the light comes from outside of the middle"
    steps.say(f"{source.name}: bakes {told} from {ends}{' and the scenery around it' * (chosen.shells > 1)}{why}")
    if field.background == "last" and chosen.shells == 1:
        field = replace(field, background=None)
        steps.say(f"{source.name}: leaves out the colour of the last sample, which the program shows behind all rays")
    with source.blamed(steps, "baking"):
        tree = build_n3tree(
            bake_function(
                field,
                resolution=options.resolution or RESOLUTION,
                basis=options.basis,
                part=chosen,
                cameras=cameras,
                sigma_min=sigma_min or 0.0,
            )
        )
    with source.blamed(steps, "measuring the loss"):
        lost = measure_function(field, build_field_from_n3tree(tree), views, chosen.whole)
    seen = f"{lost.psnr:.2f} dB against {len(views.cameras)} pictures of the field itself"
    steps.say(f"{source.name}: {tree}, {seen}; {lost.outside:.2%} of their light is from outside of what was baked")
    return tree, field
