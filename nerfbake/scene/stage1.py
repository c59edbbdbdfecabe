"""The output of nerf2mesh's stage 1, and MobileNeRF's: textured meshes and their specular appearance.

The specular appearance is a feature texture per mesh and one small MLP, which is evaluated for every pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.cluster.colours import MAX_CHANNELS
from nerfbake.kernels.soundness import count_problem
from nerfbake.scene.base import Scene
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.mesh import Mesh

MAX_WEIGHT = 1e6  # keeps every sum of the MLP finite in float32
MAX_WIDTH = 1024
MAX_MIDDLE = 6


@dataclass(frozen=True, eq=False, repr=False)
class SpecularField(CompactRepr):
    """specular(f, d) = sigmoid(relu([d, f] W0) W1), added to the diffuse colour.

    features  (H, W, F) uint8, f = features / 255; row 0 is the image's top. nerf2mesh has 3, MobileNeRF 8
    w0        (3 + F, h) float32: the rows of the unit view direction (from the camera to the surface), then those of
              the feature
    w1        (h', 3) float32; h' = h if there are no layers between
    used      (H, W) bool: the texels that a triangle shows; the others have no weight
    middle    weights (in, out) float32 of the layers between W0 and W1, each followed by a ReLU; nerf2mesh has none
    biases    (out,) float32 of all layers, added before the ReLU; () for none, as in nerf2mesh

    Sources: nerf2mesh, MobileNeRF; docs/formats/atlas.md, "The stage-1 folder" and "MobileNeRF's folder".

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
    middle: tuple[npt.NDArray[np.float32], ...] = ()
    biases: tuple[npt.NDArray[np.float32], ...] = ()

    def __post_init__(self) -> None:
        shape = self.features.shape
        if self.features.ndim != 3 or not self.features.size or self.features.dtype != np.uint8:
            found = f"have shape {shape}, dtype {self.features.dtype}"
            raise InvalidScene(Problem("features", found, f"(H, W, F) uint8, F to {MAX_CHANNELS}"))
        if self.channels > MAX_CHANNELS:
            raise InvalidScene(Problem("features", f"have {self.channels} channels", f"1 to {MAX_CHANNELS}"))
        self._require_layers()
        layers = (self.w0, *self.middle, self.w1)
        named = [(f"net.{k}.weight", weights) for k, weights in enumerate(layers)]
        for name, weights in [*named, *((f"net.{k}.bias", bias) for k, bias in enumerate(self.biases))]:
            wrong = ~(np.abs(weights) <= MAX_WEIGHT)
            if problems := count_problem(name, wrong, weights, f"a finite number within {MAX_WEIGHT:g}"):
                raise InvalidScene(problems[0])
        if self.used.shape != shape[:2] or self.used.dtype != np.bool_:
            found = f"has shape {self.used.shape}, dtype {self.used.dtype}"
            raise InvalidScene(Problem("used", found, f"{shape[:2]} bool"))
        if not self.used.any():
            raise InvalidScene(Problem("used", "marks no texel", "a mesh whose triangles cover at least one texel"))

    def _require_layers(self) -> None:
        """Raise InvalidScene unless the shapes of the layers match."""
        F, widths = self.channels, [self.w0.shape[-1], *(weights.shape[-1] for weights in self.middle)]
        if self.w0.ndim != 2 or self.w0.shape[0] != 3 + F or not all(1 <= width <= MAX_WIDTH for width in widths):
            found = f"has shape {self.w0.shape}" if not self.middle else f"has layers of {widths} units"
            allowed = f"({3 + F}, h): 3 of direction, {F} of colour, h to {MAX_WIDTH}"
            raise InvalidScene(Problem("net.0.weight", found, allowed))
        if len(self.middle) > MAX_MIDDLE:
            raise InvalidScene(Problem("the MLP", f"has {2 + len(self.middle)} layers", f"2 to {2 + MAX_MIDDLE}"))
        for k, (weights, width) in enumerate(zip((*self.middle, self.w1), widths, strict=True), 1):
            out = 3 if k == len(widths) else weights.shape[-1]
            if weights.shape != (width, out):
                found = f"has shape {weights.shape}"
                raise InvalidScene(Problem(f"net.{k}.weight", found, f"{(width, out)} after net.{k - 1}.weight"))
        shapes = [bias.shape for bias in self.biases]
        if self.biases and shapes != [(width,) for width in [*widths, 3]]:
            raise InvalidScene(Problem("the biases", f"have shapes {shapes}", f"{[*widths, 3]} numbers, or none"))

    @property
    def channels(self) -> int:
        """The number F of features of a texel."""
        return int(self.features.shape[2])

    @property
    def mlp(self) -> tuple[Singles, Singles, tuple[Singles, ...], tuple[Singles, ...]]:
        """The MLP's weights and biases, as kernels.surface.mlp takes them."""
        return self.w0, self.w1, self.middle, self.biases

    @property
    def mlp_text(self) -> str:
        """The MLP's inputs, hidden units and outputs, as in 'MLP 6-32-3'."""
        return "MLP " + "-".join(map(str, [len(self.w0), *(w.shape[1] for w in (self.w0, *self.middle)), 3]))

    def __str__(self) -> str:
        H, W, _ = self.features.shape
        return f"feature texture of {W}x{H}, {int(self.used.sum()):,} texels used, {self.mlp_text}"


@dataclass(frozen=True, eq=False, repr=False)
class Stage1(Scene):
    """Cascades (nested boxes, each twice as wide) of one scene; cascade c is entry c of each tuple.

    MobileNeRF's shapes, parts of one mesh with a texture each, are cascades, too.

    fields   feature textures, with the MLP that they share
    meshes   with the diffuse colour as their texture; None for a missing mesh
    files    the meshes and diffuse textures of the folder by name, copied to the output unchanged; empty for a scene
             that was not read from a folder
    cameras  (c, 3) float64 positions of the training cameras, in the world of the meshes; None if unknown
    deferred  MobileNeRF's way to render: the MLP's output is the whole colour, and of several rays a pixel, features
             and directions are averaged before the MLP

    Sources: nerf2mesh and its forks, MobileNeRF; docs/formats/atlas.md.

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
    deferred: bool = False

    def __str__(self) -> str:
        return "; ".join(map(str, self.fields))


def diffuse_name(files: Mapping[str, bytes | memoryview], cascade: int) -> str | None:
    """The file name of a cascade's diffuse texture, a JPEG or PNG; None if there is none."""
    return next((name for name in (f"feat0_{cascade}.jpg", f"feat0_{cascade}.png") if name in files), None)
