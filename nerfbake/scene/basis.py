"""The meaning of a node's D values: svox's `data_format`."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from nerfbake.errors import InvalidScene, Problem

SH_SIZES = (1, 4, 9, 16, 25)
SH0 = 0.28209479177387814  # the first spherical harmonic, a constant
_SIGNS = {-1: "m", 0: "", 1: "p"}  # the shaders use the same names


class Basis(NamedTuple):
    """The basis functions of a colour.

    kind  'SH', 'SG', 'ASG' or 'RGBA'
    size  B, the number of basis functions per colour channel

    The D values are all B coefficients of red, then of green, then of blue, then the density sigma: D = 3 B + 1. RGBA
    has B = 1: red, green, blue, sigma.
    """

    kind: str
    size: int

    def __str__(self) -> str:
        return self.kind if self.kind == "RGBA" else f"{self.kind}{self.size}"

    @property
    def data_dim(self) -> int:
        return 3 * self.size + 1


def parse_basis(data_format: str) -> Basis:
    """'SH9' -> Basis('SH', 9). Raises InvalidScene for a name that svox does not define."""
    match = re.fullmatch(r"(SH|SG|ASG)([1-9][0-9]{0,3})|RGBA", data_format)
    if match and not match[1]:
        return Basis("RGBA", 1)
    if match and (match[1] != "SH" or int(match[2]) in SH_SIZES):
        return Basis(match[1], int(match[2]))
    known = f"RGBA, SGk, ASGk, or SHk with k of {', '.join(map(str, SH_SIZES))}"
    raise InvalidScene(Problem("data_format", f"is {data_format[:40]!r}", known))


def renderable_basis(data_format: str) -> Basis:
    """Like parse_basis(), for bases that can be rendered: SH and RGBA. Raises InvalidScene for other bases and ''."""
    if not data_format:
        raise InvalidScene(Problem("data_format", "is not known", "SHk or RGBA"))
    basis = parse_basis(data_format)
    if basis.kind not in ("SH", "RGBA"):
        raise InvalidScene(Problem("data_format", f"is {data_format}", "SHk or RGBA can be rendered"))
    return basis


def guess_data_format(data_dim: int) -> str:
    """The format of a file that does not name one, by svox's rule: 4 values are RGBA, 3 k + 1 are SHk.

    '' if neither applies.
    """
    if data_dim == 4:
        return "RGBA"
    size, rest = divmod(data_dim - 1, 3)
    return f"SH{size}" if rest == 0 and size in SH_SIZES else ""


def coefficient_names(basis: Basis) -> list[str]:
    """The names of a colour's B coefficients, in order. f1_m1 is f1^-1, because a name cannot contain a sign.

    >>> coefficient_names(parse_basis("SH4"))
    ['f0_0', 'f1_m1', 'f1_0', 'f1_p1']
    """
    if basis.kind != "SH":
        return [f"lobe{i}" for i in range(basis.size)]
    degrees = range(SH_SIZES.index(basis.size) + 1)
    return [f"f{degree}_{_SIGNS[(m > 0) - (m < 0)]}{abs(m)}" for degree in degrees for m in range(-degree, degree + 1)]


def voxel_dtype(basis: Basis, number: np.dtype[Any]) -> np.dtype[Any]:
    """The structured dtype of a node's values, in storage order.

    Red, green and blue have their coefficients as fields; sigma is last. A colour of RGBA is a single number.
    """
    colour = number if basis.kind == "RGBA" else np.dtype([(name, number) for name in coefficient_names(basis)])
    return np.dtype([("red", colour), ("green", colour), ("blue", colour), ("sigma", number)])
