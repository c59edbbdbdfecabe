"""Radiance field and cameras -> what rays see of each leaf, and from where."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.kernels.march.importance import collect_maxima
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import placed, turned
from nerfbake.kernels.maths.products import product
from nerfbake.kernels.parallel import cores, over_chunks
from nerfbake.scene.camera import Cameras
from nerfbake.scene.radiance_field import RadianceField

_CUT = 1e-4  # of transmittance: what renderers do not follow any further
_RAY_BYTES = 140  # a ray of a camera that is marched
_EVERY = 8  # rays that hit something are enough for the mean over directions
_SPHERE = 1 / (4 * np.pi)

Floats = npt.NDArray[np.float64]


class Importance(NamedTuple):
    """largest (leaves,) float32: the largest transmittance times alpha with which a ray saw each leaf of the field.

    gram (B, B) float64: the mean of basis(d) basis(d)^T over the rays' directions d, each weighed with how much of it
    the scene keeps; so x^T gram x is the mean square of what coefficients x look like.
    """

    largest: npt.NDArray[np.float32]
    gram: npt.NDArray[np.float64]


def weigh_leaves(field: RadianceField, cameras: Cameras) -> Importance:
    """What the rays of all these cameras see, the same for any number of threads. Raises MemoryLimit.

    >>> from nerfbake import build_field, sample_n3tree, sphere_cameras, weigh_leaves
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> importance = weigh_leaves(field, sphere_cameras(field, frames=8, edge=64))
    >>> importance.largest.shape, importance.gram.shape
    ((573,), (9, 9))
    """
    views = cameras.cameras
    cameras.require_covered()
    threads = min(len(views), cores())
    pixels = max(view.width * view.height for view in views)
    need = 4 * len(field.values) * threads + threads * pixels * _RAY_BYTES
    with memory.lent("weighing leaves", need + sum(view.width * view.height for view in views) * 32 // _EVERY):
        spare: list[npt.NDArray[np.float32]] = []  # a thread takes one and gives it back
        seen: list[tuple[Floats, Floats]] = [(np.empty((0, 3)), np.empty(0))] * len(views)

        def work(begin: int, end: int) -> None:
            try:
                largest = spare.pop()
            except IndexError:
                largest = np.zeros(len(field.values), np.float32)
            for i in range(begin, end):
                origin, looks = views[i].rays()
                alpha = np.empty(len(looks), np.float32)
                place, turn = placed(origin, field.place), field.place[:, :3]
                collect_maxima(
                    field.cells, field.densities, field.box, place, turned(looks, turn), _CUT, largest, alpha
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
    """The mean of basis basis^T over directions in the world, weighed."""
    size, rgba = field.basis.size, field.basis.kind == "RGBA"
    if rgba:  # the only function is 1
        return np.ones((1, 1))
    total = np.zeros((size, size))
    for looks, alpha in seen:
        basis = sh_basis(turned(looks, field.axes), size)
        total += product((basis * alpha[:, None]).T, basis)
    # The first function is constant, so that its mean square is known. Where nothing was hit: as if from everywhere.
    return total * (_SPHERE / total[0, 0]) if total[0, 0] > 0 else np.eye(size) * _SPHERE
