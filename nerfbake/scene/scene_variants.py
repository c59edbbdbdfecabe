"""The same scene in several representations, of which a viewer shows one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume

Representation = Literal["splats", "mesh", "volume"]
REPRESENTATIONS: dict[Representation, type] = {"splats": Splats, "mesh": Meshes, "volume": Volume}


@dataclass(frozen=True, eq=False, repr=False)
class SceneVariant(CompactRepr):
    """A representation of a scene.

    scene  the splats, the meshes or the volume; z is up in splats that say so and in meshes, y in a volume
    psnr   mean PSNR of its pictures against those of the scene that it was made of, in dB

    >>> import numpy as np
    >>> from nerfbake import Splats, SceneVariant
    >>> one, turn = np.full((1, 3), 0.1, np.float32), np.array([[1, 0, 0, 0]], np.float32)
    >>> SceneVariant("splats", Splats(one, one, turn, np.ones(1, np.float32), one[:, None]), 31.5)
    <SceneVariant: splats, 31.50 dB (1 splat of SH degree 0)>
    """

    name: Representation
    scene: Splats | Meshes | Volume
    psnr: float

    def __str__(self) -> str:
        return f"{self.name}, {self.psnr:.2f} dB ({self.scene})"


@dataclass(frozen=True, eq=False, repr=False)
class SceneVariants(Scene):
    """A scene in several representations, each once. A viewer shows the first, unless its user chooses another.

    >>> import numpy as np
    >>> from nerfbake import Splats, SceneVariant, SceneVariants
    >>> one, turn = np.full((1, 3), 0.1, np.float32), np.array([[1, 0, 0, 0]], np.float32)
    >>> splats = Splats(one, one, turn, np.ones(1, np.float32), one[:, None])
    >>> SceneVariants((SceneVariant("splats", splats, 31.5),))
    <SceneVariants: variants: splats, 31.50 dB (1 splat of SH degree 0)>
    """

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
        return f"variants: {'; '.join(map(str, self.variants))}"
