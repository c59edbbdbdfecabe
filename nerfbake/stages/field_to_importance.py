"""Radiance field and cameras -> the importance of each leaf, and the distribution of view directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.march.directions import collect_maxima
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import rotate, transform_points
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.parallel import cores, over_chunks
from nerfbake.scene.camera import Cameras
from nerfbake.scene.radiance_field import RadianceField

_CUT = 1e-4  # transmittance at which renderers end a ray
_RAY_BYTES = 140  # per ray of a camera during the march
_EVERY = 8  # every 8th ray that hits something is used for the mean over directions
_SPHERE = 1 / (4 * np.pi)


class Importance(NamedTuple):
    """The importance of a field's leaves, and the Gram matrix of its basis functions.

    largest  (leaves,) float32: the largest transmittance times alpha of each leaf over all rays
    gram     (B, B) float64: the mean of basis(d) basis(d)^T over the rays' directions d, weighted by the rays' alpha.
             x^T gram x is the mean square, over these rays, of the colour with coefficients x
    """

    largest: npt.NDArray[np.float32]
    gram: npt.NDArray[np.float64]


def weigh_leaves(field: RadianceField, cameras: Cameras) -> Importance:
    """Compute the importance of each leaf for the rays of all these cameras.

    The result does not depend on the number of threads. Raises MemoryLimit.

    >>> from nerfbake import build_field, sample_n3tree, scatter_cameras, weigh_leaves
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> importance = weigh_leaves(field, scatter_cameras(field, frames=8, edge=64))
    >>> importance.largest.shape, importance.gram.shape
    ((573,), (9, 9))
    """
    views = cameras.cameras
    cameras.require_covered()
    threads = min(len(views), cores())
    pixels = max(view.width * view.height for view in views)
    need = 4 * len(field.values) * threads + threads * pixels * _RAY_BYTES
    with memory.lent("weighing leaves", need + sum(view.width * view.height for view in views) * 32 // _EVERY):
        spare: list[npt.NDArray[np.float32]] = []  # one buffer per thread, reused for its next camera
        seen: list[tuple[Floats, Floats]] = [(np.empty((0, 3)), np.empty(0))] * len(views)

        def work(begin: int, end: int) -> None:
            try:
                largest = spare.pop()
            except IndexError:
                largest = np.zeros(len(field.values), np.float32)
            for i in range(begin, end):
                origin, looks = views[i].rays()
                alpha = np.empty(len(looks), np.float32)
                place, turn = transform_points(origin, field.place), field.place[:, :3]
                collect_maxima(
                    field.cells, field.densities, field.box, place, rotate(looks, turn), _CUT, largest, alpha
                )
                hit = np.flatnonzero(alpha > 0)[::_EVERY]
                seen[i] = looks[hit], alpha[hit].astype(np.float64)
            spare.append(largest)
            progress.report(end / len(views))

        over_chunks(work, len(views), 1)
        largest = spare[0]
        for other in spare[1:]:
            np.maximum(largest, other, out=largest)
        return Importance(largest, _gram(field, seen))


def _gram(field: RadianceField, seen: list[tuple[Floats, Floats]]) -> Floats:
    """Return the weighted mean of basis basis^T over directions in the world."""
    size, rgba = field.basis.size, field.basis.kind == "RGBA"
    if rgba:  # the only basis function is 1
        return np.ones((1, 1))
    total = np.zeros((size, size))
    for looks, alpha in seen:
        basis = sh_basis(rotate(looks, field.axes), size)
        total += product((basis * alpha[:, None]).T, basis)
    # The first function is constant, so its mean square is known. If no ray hit anything, assume uniform directions.
    return total * (_SPHERE / total[0, 0]) if total[0, 0] > 0 else np.eye(size) * _SPHERE
