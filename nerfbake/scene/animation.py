"""Pictures to be seen one after the other."""

from __future__ import annotations

from dataclasses import dataclass

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene
from nerfbake.scene.image import Image


@dataclass(frozen=True, eq=False, repr=False)
class Animation(Scene):
    """frames: pictures of one size, all transparent or none; after the last comes the first.

    >>> from nerfbake import Animation, build_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> views = orbit_cameras(field, frames=3, width=16, height=12).cameras
    >>> print(Animation(tuple(render_field(field, view) for view in views)))
    animation of 3 pictures of 16x12
    """

    frames: tuple[Image, ...]

    def __post_init__(self) -> None:
        if not self.frames:
            raise InvalidScene(Problem("animation", "has no pictures", "at least one"))
        for number, frame in enumerate(self.frames):
            if frame.size != self.size:
                found = f"has {frame.size[0]}x{frame.size[1]} pixels"
                raise InvalidScene(Problem(f"picture {number}", found, f"{self.size[0]}x{self.size[1]}, as the first"))
            if (frame.background is None) != self.transparent:
                raise InvalidScene(Problem(f"picture {number}", "differs in transparency", "all transparent or none"))

    def __str__(self) -> str:
        return f"animation of {len(self.frames)} pictures of {self.size[0]}x{self.size[1]}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.frames[0].size

    @property
    def transparent(self) -> bool:
        return self.frames[0].background is None
