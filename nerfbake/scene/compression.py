"""A compressed octree with its size and its loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nerfbake.errors import BudgetMissed, Problem
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.quantised_octree import QuantisedOctree


@dataclass(frozen=True, eq=False, repr=False)
class Compression(CompactRepr):
    """The result of a search for compression parameters.

    pruned       the share of the leaves with a density that were pruned
    size         bytes of the file
    error        the mean squared difference of its pictures from the original's, sRGB in 0..1
    loss         dB of PSNR against photographs: measured, or at most this, as predicted with a margin
    expected     dB, the same as loss if it is measured; else predicted without a margin, as 10 log10(1 + error / M)
    source_psnr  dB of the original against photographs, measured, or assumed to compute M
    views        the number of views for error and loss

    >>> from nerfbake import build_octree, compress_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> found = compress_octree(octree, coded_size=lambda quantised: quantised.m, step=0.1)
    >>> found.quantised.colour_step, found.source_psnr
    (0.1, 30.5)
    """

    quantised: QuantisedOctree
    pruned: float
    size: int
    error: float
    loss: float
    expected: float
    measured: bool
    source_psnr: float
    views: int

    def __str__(self) -> str:
        how = "measured" if self.measured else f"at most ({self.expected:.3f} dB expected), predicted"
        source = f"on {self.views} views of a source of {self.source_psnr:.2f} dB"
        return f"{100 * self.pruned:.1f} % pruned, {self.loss:.3f} dB {how} {source}"

    @property
    def facts(self) -> dict[str, Any]:
        """The result for scripts."""
        facts = {name: value for name, value in vars(self).items() if name != "quantised"}
        return {"leaves": self.quantised.m, "step": self.quantised.colour_step, **facts}

    def require(self, max_loss: float) -> None:
        """Raise BudgetMissed if the loss exceeds max_loss."""
        if self.loss > max_loss:
            problem = Problem("the octree", f"loses {self.loss:.3f} dB at the finest step", f"`max_loss={max_loss:g}`")
            raise BudgetMissed(problem)
