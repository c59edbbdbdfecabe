"""What nerf2mesh's stage 1 leaves behind: meshes with textures, and one MLP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from nerfbake.scene.base import Scene
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.specular import SpecularField


@dataclass(frozen=True, eq=False, repr=False)
class Stage1(Scene):
    """Cascades (nested boxes, each twice as wide) of one scene; cascade c is entry c of each tuple.

    fields   their feature textures, with the MLP that they share
    meshes   with the diffuse colour as their texture; None where the mesh is not there
    files    the meshes and diffuse textures as they stand in the folder, by name, to be handed on untouched; of a
             scene that was made and not read there are none
    cameras  (c, 3) float64 where the training cameras stand, in the meshes' own world; None if nobody knows
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
    """The name of a cascade's diffuse texture, a JPEG or PNG, if it is there."""
    return next((name for name in (f"feat0_{cascade}.jpg", f"feat0_{cascade}.png") if name in files), None)
