"""The output of nerf2mesh's stage 1: textured meshes and their specular appearance.

The specular appearance is a feature texture per mesh and one small MLP, which is evaluated for every pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import count_problem
from nerfbake.scene.base import Scene
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.mesh import Mesh

MAX_WEIGHT = 1e6  # keeps every sum of the MLP finite in float32
MAX_WIDTH = 1024


@dataclass(frozen=True, eq=False, repr=False)
class SpecularField(CompactRepr):
    """specular(f, d) = sigmoid(relu([d, f] W0) W1), added to the diffuse colour.

    features  (H, W, 3) uint8, f = features / 255; row 0 is the image's top
    w0        (6, h) float32: the rows of the unit view direction (from the camera to the surface), then those of the
              feature
    w1        (h, 3) float32
    used      (H, W) bool: the texels that a triangle shows; the others have no weight

    Source: nerf2mesh; docs/formats/atlas.md, "The stage-1 folder".

    >>> import numpy as np
    >>> from nerfbake import SpecularField
    >>> features, used = np.full((4, 4, 3), 128, np.uint8), np.ones((4, 4), bool)
    >>> print(SpecularField(features, np.eye(6, 8, dtype=np.float32), np.eye(8, 3, dtype=np.float32), used))
    feature texture of 4x4, 16 texels used, MLP 6-8-3
    """

    features: npt.NDArray[np.uint8]
    w0: npt.NDArray[np.float32]
    w1: npt.NDArray[np.float32]
    used: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        shape = self.features.shape
        if self.features.ndim != 3 or shape[2] != 3 or not self.features.size or self.features.dtype != np.uint8:
            found = f"have shape {shape}, dtype {self.features.dtype}"
            raise InvalidScene(Problem("features", found, "(H, W, 3) uint8"))
        if self.w0.ndim != 2 or self.w0.shape[0] != 6 or not 1 <= self.w0.shape[1] <= MAX_WIDTH:
            found = f"has shape {self.w0.shape}"
            raise InvalidScene(Problem("net.0.weight", found, f"(6, h): 3 of direction, 3 of colour, h to {MAX_WIDTH}"))
        if self.w1.shape != (self.w0.shape[1], 3):
            found = f"has shape {self.w1.shape}"
            raise InvalidScene(Problem("net.1.weight", found, f"{(self.w0.shape[1], 3)} after net.0.weight"))
        for name, weights in (("net.0.weight", self.w0), ("net.1.weight", self.w1)):
            wrong = ~(np.abs(weights) <= MAX_WEIGHT)
            if problems := count_problem(name, wrong, weights, f"a finite number within {MAX_WEIGHT:g}"):
                raise InvalidScene(problems[0])
        if self.used.shape != shape[:2] or self.used.dtype != np.bool_:
            found = f"has shape {self.used.shape}, dtype {self.used.dtype}"
            raise InvalidScene(Problem("used", found, f"{shape[:2]} bool"))
        if not self.used.any():
            raise InvalidScene(Problem("used", "marks no texel", "a mesh whose triangles cover at least one texel"))

    def __str__(self) -> str:
        H, W, _ = self.features.shape
        return f"feature texture of {W}x{H}, {int(self.used.sum()):,} texels used, MLP 6-{self.w0.shape[1]}-3"


@dataclass(frozen=True, eq=False, repr=False)
class Stage1(Scene):
    """Cascades (nested boxes, each twice as wide) of one scene; cascade c is entry c of each tuple.

    fields   feature textures, with the MLP that they share
    meshes   with the diffuse colour as their texture; None for a missing mesh
    files    the meshes and diffuse textures of the folder by name, copied to the output unchanged; empty for a scene
             that was not read from a folder
    cameras  (c, 3) float64 positions of the training cameras, in the world of the meshes; None if unknown

    Source: nerf2mesh and its forks; docs/formats/atlas.md, "The stage-1 folder".

    >>> import numpy as np
    >>> from nerfbake import SpecularField, Stage1
    >>> features, used = np.full((4, 4, 3), 128, np.uint8), np.ones((4, 4), bool)
    >>> field = SpecularField(features, np.eye(6, 8, dtype=np.float32), np.eye(8, 3, dtype=np.float32), used)
    >>> print(Stage1((field,), (None,)))
    feature texture of 4x4, 16 texels used, MLP 6-8-3
    """

    fields: tuple[SpecularField, ...]
    meshes: tuple[Mesh | None, ...]
    files: Mapping[str, bytes | memoryview] = field(default_factory=dict)
    cameras: npt.NDArray[np.float64] | None = None

    def __str__(self) -> str:
        return "; ".join(map(str, self.fields))


def diffuse_name(files: Mapping[str, bytes | memoryview], cascade: int) -> str | None:
    """The file name of a cascade's diffuse texture, a JPEG or PNG; None if there is none."""
    return next((name for name in (f"feat0_{cascade}.jpg", f"feat0_{cascade}.png") if name in files), None)
