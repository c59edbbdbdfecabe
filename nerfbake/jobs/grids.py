"""Select the grids of a volume to read or write, and its up axis; say which ones are left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nerfbake import catalog, io
from nerfbake.errors import InvalidFile, UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps
from nerfbake.kernels.soundness import plural

if TYPE_CHECKING:
    from nerfbake.scene.volume import Volume

_LISTED = 10  # most grids that a line names
GRIDS = ("density", "Cd", "sh", "index")


@dataclass(frozen=True, kw_only=True)
class GridChoice:
    """Grids of a volume, by name or number, and its up axis. By default the volume is not changed."""

    grids: tuple[str, ...] = ()
    in_up: str | None = None

    def __bool__(self) -> bool:
        return bool(self.grids or self.in_up)

    def of(self, steps: Steps, source: Source, scene: Any) -> Any:
        """Return the scene with this choice applied. Raises UsageError if there is a choice and it is not a volume."""
        from nerfbake.scene.volume import Volume

        if self and not isinstance(scene, Volume):
            raise UsageError(f"{source.name} is not a volume; allowed: no `grid` and no `in_up`")
        if self.in_up not in (None, "y", "z"):
            raise UsageError(f"`in_up` of a volume is {self.in_up!r}; allowed: y, z")
        if self:
            with source.blamed(steps, "choosing grids"):
                scene = scene.only(self.grids) if self.grids else scene
                scene = scene.turned() if self.in_up == "y" else scene
        return scene

    def whole(self, steps: Steps, source: Source, scene: Any) -> Any:
        """Like of(), but raises InvalidFile if a grid cannot be read and is not excluded by the choice."""
        from nerfbake.scene.volume import Volume

        chosen = self.of(steps, source, scene)
        if isinstance(chosen, Volume) and chosen.unread:
            problem = chosen.unread[0]
            raise InvalidFile(problem._replace(allowed=f"{problem.allowed}; `grid` for the others"), source=source.path)
        return chosen


def tell_unused(steps: Steps, source: Source, scene: Any) -> None:
    """Print the grids of a volume that its field leaves out. Call it before the field is built; for any scene."""
    from nerfbake.scene.volume import Volume
    from nerfbake.stages.scene_to_field import unused_grids

    if not isinstance(scene, Volume):
        return
    with io.blame(source.name):
        unused = unused_grids(scene)
    if unused:
        more = f" and {len(unused) - _LISTED} more" if len(unused) > _LISTED else ""
        steps.say(f"{source.name}: leaves out {plural(len(unused), 'grid')}: {', '.join(unused[:_LISTED])}{more}")


def require_grids(form: catalog.Format, grids: str | None, *, half: bool) -> tuple[str, ...]:
    """Return these grids, or the default grids of the format. Call it before doing any work.

    Raises UsageError if the format cannot store them.
    """
    module = form.load_volume_module()
    wanted = module.DEFAULT_GRIDS if grids is None else tuple(grids.split(","))
    if not set(wanted) <= set(GRIDS) or len(set(wanted)) < len(wanted) or ("index" in wanted and len(wanted) > 1):
        raise UsageError(f"`grids` are {','.join(wanted)!r}; allowed: some of density, Cd, sh, or index alone")
    module.require_grids(wanted, half=half)
    return wanted


def warn_about_halves(steps: Steps, form: catalog.Format, volume: Volume) -> None:
    """Print a note if other programs have problems with a float16 density in this format."""

    from nerfbake.scene.vdb import VdbTree

    note, first = form.load_volume_module().HALF_NOTE, volume.grids[0]
    if note and isinstance(first, VdbTree) and first.values.dtype == "float16":
        steps.say(note)
