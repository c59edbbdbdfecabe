"""The splats of one or several files that become a smaller file: joined, and cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nerfbake import io, memory
from nerfbake.errors import UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.splat_choice import SplatChoice
from nerfbake.jobs.steps import Steps
from nerfbake.scene.origin import origin_text
from nerfbake.scene.placement import Move, placement_matrix
from nerfbake.scene.splats import MOVING, Splats, join_splats, splats_size
from nerfbake.scene.views import world_box
from nerfbake.stages.splat_box import cut_splats
from nerfbake.stages.splats_to_splats import cut_floaters, cut_largest_part


@dataclass(frozen=True, kw_only=True)
class SplatParts:
    """Which splats of the input are kept, in this order of steps. By default all.

    box       x0, y0, z0, x1, y1, z1 in the world of the file: those with their centre in this box; None: all
    floaters  drop isolated splats, faint clouds, and huge splats far outside
    largest   keep the largest connected part
    """

    box: tuple[float, ...] | None = None
    floaters: bool = False
    largest: bool = False

    def require(self, reading: Reading) -> None:
        """Raise UsageError for a choice that has no effect on what was read."""
        taken: dict[str, tuple[type, ...]] = dict.fromkeys(("box", "floaters", "largest"), (Splats,))
        reading.require(taken=taken, box=self.box, floaters=self.floaters or None, largest=self.largest or None)

    def of(self, steps: Steps, source: Source, splats: Splats) -> Splats:
        """Return the splats that are kept, and print how many are not. Raises NerfbakeError."""
        kept = splats
        with source.blamed(steps, "cutting the splats"):
            if self.box is not None:
                kept = cut_splats(kept, world_box(self.box) - kept.origin, opacity_min=0).splats
                _tell(steps, source, splats, kept, "outside the box")
            if self.floaters:
                before, kept = kept, cut_floaters(kept)
                _tell(steps, source, before, kept, "that float")
            if self.largest:
                before, kept = kept, cut_largest_part(kept)
                _tell(steps, source, before, kept, "outside the largest part")
        return kept


def _tell(steps: Steps, source: Source, before: Splats, after: Splats, which: str) -> None:
    steps.say(f"{source.name}: leaves out {before.n - after.n:,} of {before.n:,} splats {which}")


@dataclass(frozen=True)
class Placement:
    """Where the splats of an input are put. number: of the input, from 1; moves: steps, the first is applied first."""

    number: int
    moves: tuple[Move, ...]


def require_places(places: Sequence[Placement], inputs: int) -> None:
    """Raise UsageError for a placement of no input, or a second one of an input. Call it before doing any work."""
    numbers = [place.number for place in places]
    for number in numbers:
        if not 1 <= number <= inputs:
            raise UsageError(f"`place` names input {number}; allowed: 1 to {inputs}")
        if numbers.count(number) > 1:
            raise UsageError(f"`place` names input {number} twice; allowed: all steps of an input together")


def read_joined(
    steps: Steps,
    sources: Sequence[Source],
    first: Splats,
    choice: SplatChoice = SplatChoice(),
    places: Sequence[Placement] = (),
) -> Splats:
    """Return `first`, the splats of the first source, joined with those of all others, in one world.

    choice: the axes of all files. Splats with a placement are moved there from the world of their file. Raises
    UsageError if stdin is read twice, NerfbakeError.
    """
    parts = [first]
    for source in sources[1:]:
        found: Splats = source.read(steps, Splats)
        if not parts[0].origin.any() and found.origin.any():
            steps.say(f"{source.name}: lies far from {sources[0].name}, around {origin_text(found.origin)}")
        if found.antialiased != first.antialiased:
            is_, was = ("", "not ") if found.antialiased else ("not ", "")
            steps.say(f"{source.name}: is {is_}antialiased, and OUT is {was}antialiased, as {sources[0].name}")
        parts.append(found)
    parts = [choice.read(steps, source, part) for source, part in zip(sources, parts, strict=True)]
    for place in places:
        number = place.number - 1
        with io.blame(sources[number].name):
            memory.require(
                "moving the splats", MOVING * parts[number].n + splats_size(parts[number].n, parts[number].B)
            )
            parts[number] = parts[number].transformed(placement_matrix(place.moves))
    if len(parts) == 1:
        return parts[0]
    with io.blame(sources[0].name):
        total, most = sum(part.n for part in parts), max(part.B for part in parts)
        memory.require(f"{total:,} splats", splats_size(total, most))
        return join_splats([part.relative_to(parts[0].origin) for part in parts])


def require_sources(sources: Sequence[Source]) -> None:
    """Raise UsageError if there is none, or stdin twice. Call it before doing any work."""
    if not sources:
        raise UsageError("there is no input; allowed: one scene, or several files of splats")
    if sum(source.path == io.STREAM for source in sources) > 1:
        raise UsageError("several inputs are stdin, which can be read once; allowed: '-' for one of them")
