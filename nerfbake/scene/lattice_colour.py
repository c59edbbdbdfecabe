"""What the values between a lattice's nodes are made colours by: sums of harmonics, a sigmoid, an MLP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.scene.base import number_problems, require_shape
from nerfbake.scene.specular import MAX_WEIGHT

MAX_UNITS, MAX_LAYERS, MAX_FREQUENCY = 1024, 16, 4096.0  # of an MLP
MAX_ANGLE = 1e6  # radians that sines are made of


class ShColour(NamedTuple):
    """Each channel is max(0, 1/2 + sum Y_b(d) c_b), with size coefficients of red, then of green, then of blue."""

    size: int

    @property
    def features(self) -> int:
        return 3 * self.size

    def __str__(self) -> str:
        return f"SH{self.size}, cut at 0"


class RgbColour(NamedTuple):
    """Each channel is the sigmoid of its value, the same in every direction."""

    features: int = 3

    def __str__(self) -> str:
        return "RGB"


@dataclass(frozen=True, eq=False)
class MlpColour:
    """The sigmoid of what an MLP makes of features and of the direction: relu between its layers, of H units each.

    first    (H, F + 2 e j + 3 + 6 k) float32, of F features, of sin and cos of the last e of them, of d, of sin and
             cos of d: of the first of these times each of j or k frequencies, of the second, ...; first_bias (H,)
    middle   (l, H, H) and middle_bias (l, H): the layers between; there may be none
    last     (3, H) and last_bias (3,)
    frequencies  (k,) of the direction
    direct   False: there are three more features, before the others, which are added to what the MLP makes
    encoded, feature_frequencies  e and (j,), where features go through sines and cosines, too
    """

    first: Singles
    first_bias: Singles
    middle: Singles
    middle_bias: Singles
    last: Singles
    last_bias: Singles
    frequencies: tuple[float, ...]
    direct: bool = True
    encoded: int = 0
    feature_frequencies: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        k, layers = len(self.frequencies), len(self.middle)
        H = len(self.first) if self.first.ndim == 2 else 0
        if self.inputs < max(1, self.encoded) or self.encoded < 0 or not 1 <= H <= MAX_UNITS or layers > MAX_LAYERS:
            found = f"has a first layer of {self.first.shape}, and {layers} behind it"
            allowed = f"1 to {MAX_UNITS} units, {MAX_LAYERS} layers, a feature or more, {3 + 6 * k} inputs of direction"
            allowed += f", {self._sines} of features" if self._sines else ""
            raise InvalidScene(Problem("the MLP", found, allowed))
        for name, array, shape in (
            ("first", self.first, self.first.shape),
            ("first_bias", self.first_bias, (H,)),
            ("middle", self.middle, (layers, H, H)),
            ("middle_bias", self.middle_bias, (layers, H)),
            ("last", self.last, (3, H)),
            ("last_bias", self.last_bias, (3,)),
        ):
            require_shape(f"the MLP's {name}", array, shape, np.float32)

    def __str__(self) -> str:
        return f"MLP of {len(self.middle) + 1}x{len(self.first)}"

    @property
    def weights(self) -> tuple[Singles, Singles, Singles, Singles, Singles, Singles]:
        """first, first_bias, middle, middle_bias, last, last_bias."""
        return self.first, self.first_bias, self.middle, self.middle_bias, self.last, self.last_bias

    @property
    def inputs(self) -> int:
        """Features that go through the MLP."""
        width = int(self.first.shape[1]) if self.first.ndim == 2 else 0
        return width - self._sines - 3 - 6 * len(self.frequencies)

    @property
    def _sines(self) -> int:
        """Inputs that are sines and cosines of features."""
        return 2 * self.encoded * len(self.feature_frequencies)

    @property
    def features(self) -> int:
        return self.inputs + (0 if self.direct else 3)

    @property
    def most(self) -> float:
        """The largest of the last `encoded` features that sines can be made of; infinity where none are made."""
        return MAX_ANGLE / max(self.feature_frequencies) if self._sines else float("inf")

    def problems(self) -> list[Problem]:
        numbers = np.concatenate([each.reshape(-1) for each in self.weights])
        frequencies = np.array(self.frequencies + self.feature_frequencies, np.float64)
        found = number_problems("the MLP", numbers, most=MAX_WEIGHT)
        return found + number_problems("frequencies", frequencies, most=MAX_FREQUENCY)


@dataclass(frozen=True, eq=False)
class DeferredColour:
    """A diffuse colour and what an MLP adds for a direction, once for each ray: of the ray's own sums in a picture, of
    one place's values anywhere else. At 1 the sum is cut.

    Features are red, green, blue and `others` that the MLP is asked for, too, all of them times the opacity, and then
    the opacity itself; a factor that all of them have does not matter. squashed: there is no opacity in them, and it is
    their sigmoids that are meant. mlp None: nothing is added.
    """

    mlp: MlpColour | None
    others: int = 4
    squashed: bool = False

    def __post_init__(self) -> None:
        if self.mlp and (self.mlp.features != 3 + self.others or not self.mlp.direct or self.mlp.encoded):
            found = f"takes {self.mlp.features} features"
            raise InvalidScene(Problem("the MLP", found, f"{3 + self.others}, 3 of them a colour"))

    @property
    def features(self) -> int:
        return 3 + self.others + (0 if self.squashed else 1)

    def __str__(self) -> str:
        if self.mlp:
            return f"RGB and a deferred {self.mlp}"
        return "RGB" if self.squashed else "RGB by opacity"


Colour = ShColour | RgbColour | MlpColour | DeferredColour
