"""The same scene in several representations, of which a viewer shows one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume

Representation = Literal["splats", "mesh", "volume"]
REPRESENTATIONS: dict[Representation, type] = {"splats": Splats, "mesh": Meshes, "volume": Volume}


class SceneVariant(NamedTuple):
    """A representation of a scene.

    scene  the splats, the meshes or the volume; z is up in splats that say so and in meshes, y in a volume
    psnr   mean PSNR of its pictures against those of the scene that it was made of, in dB
    """

    name: Representation
    scene: Splats | Meshes | Volume
    psnr: float


@dataclass(frozen=True, eq=False, repr=False)
class SceneVariants(Scene):
    """A scene in several representations, each once. A viewer shows the first, unless its user chooses another."""

    variants: tuple[SceneVariant, ...]

    def __post_init__(self) -> None:
        names = [variant.name for variant in self.variants]
        if not names or len(set(names)) < len(names):
            raise InvalidScene(Problem("the variants", f"are {', '.join(names) or 'none'}", "one or more, each once"))
        for variant in self.variants:
            if not isinstance(variant.scene, REPRESENTATIONS[variant.name]):
                found = f"is {type(variant.scene).__name__}"
                raise InvalidScene(Problem(variant.name, found, REPRESENTATIONS[variant.name].__name__))

    def value_problems(self) -> list[Problem]:
        """Values of each representation that cannot be used."""
        return [problem for variant in self.variants for problem in variant.scene.value_problems()]

    def __str__(self) -> str:
        parts = (f"{variant.name}, {variant.psnr:.2f} dB ({variant.scene})" for variant in self.variants)
        return f"variants: {'; '.join(parts)}"
