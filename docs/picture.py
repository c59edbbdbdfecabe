"""Draws the README's picture: the sample scene as an octree, and the same octree cut at coarser levels.

python docs/picture.py              rewrites docs/octree.png
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nerfbake import Image, build_field, build_octree, cut_octree, orbit_cameras, render_field, sample_n3tree, save

LEVELS = (8, 7, 6, 5)


def main() -> None:
    """Four pictures side by side."""
    octree = build_octree(sample_n3tree(resolution=256))
    framed = orbit_cameras(build_field(octree), width=420, height=360).cameras[0]
    camera = replace(framed, focal=1.3 * framed.fx)  # the scene is flatter than the ball around it
    pictures = [render_field(build_field(cut_octree(octree, level=level)), camera) for level in LEVELS]
    colour, alpha, depth = (
        np.concatenate([getattr(picture, name) for picture in pictures], axis=1)
        for name in ("colour", "alpha", "depth")
    )
    save(Path(__file__).with_name("octree.png"), Image(colour, alpha, depth), force=True)


if __name__ == "__main__":
    main()
