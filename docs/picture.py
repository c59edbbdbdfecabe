"""Draws the README's picture: the sample scene as an octree, and the same octree cut at coarser levels.

    python docs/picture.py              rewrites docs/octree.png (needs Pillow)

A plain orthographic march through points read with octree.sample(): slow, and independent of any renderer.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from nerfbake import SparseVoxelOctree, build_octree, cut_octree, sample_n3tree
from nerfbake.kernels.sh import sh_basis

SIZE = 420  # pixels
TOWARDS = np.array([-0.55, 0.62, -0.56])  # the direction that we look in, z up


def draw(octree: SparseVoxelOctree, steps: int = 500) -> npt.NDArray[np.uint8]:
    """(SIZE, SIZE, 3): emission and absorption along parallel rays, front to back over white."""
    forward = TOWARDS / np.linalg.norm(TOWARDS)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    plane = (np.arange(SIZE) + 0.5) / SIZE * 3.4 - 1.7
    origins = plane[None, :, None] * right - plane[:, None, None] * up - 2 * forward - [0, 0, 0.3]
    step = 4 / steps
    B = (octree.data_dim - 1) // 3
    basis = sh_basis(forward[None], B)[0]
    light, through = np.zeros((SIZE, SIZE, 3)), np.ones((SIZE, SIZE, 1))
    for k in range(steps):
        seen = through[..., 0] > 1e-3
        values = octree.sample(origins[seen] + (k + 0.5) * step * forward)
        alpha = 1 - np.exp(-values[:, -1:] * step)
        colour = 1 / (1 + np.exp(-(values[:, :-1].reshape(-1, 3, B) @ basis)))
        light[seen] += through[seen] * alpha * colour
        through[seen] *= 1 - alpha
    return np.asarray(np.rint(255 * (light + through)), np.uint8)


def main() -> None:
    """Four pictures side by side: levels 8, 7, 6 and 5."""
    octree = build_octree(sample_n3tree(resolution=256))
    pictures = [draw(cut_octree(octree, level=level)) for level in (8, 7, 6, 5)]
    Image.fromarray(np.concatenate(pictures, axis=1)).save(Path(__file__).with_name("octree.png"), optimize=True)


if __name__ == "__main__":
    main()
