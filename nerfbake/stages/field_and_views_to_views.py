"""Photographs with scenery, and the field of a part of it -> photographs of that part alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake import progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.image import WHITE
from nerfbake.scene.packed_pictures import PackedPicture, PackedPictures
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.views import Views
from nerfbake.stages.field_to_image import render_field

_SEEN = 128  # of 255: alpha of a pixel that shows the field


def cut_out_field(views: Views, field: RadianceField) -> Views:
    """Return photographs that show nothing but a field: the opacity of its pictures becomes their alpha.

    views: photographs with scenery. field: a part of what they show, such as the inner cube, in the same world. Pixels
    that views.used() excludes become transparent. Views that do not show the field are left out. The result is
    `rough`, because the edges of a field are not exact, and something in front of it may hide it. Raises
    InvalidScene if no view shows the field, MemoryLimit.

    >>> from nerfbake import build_field, build_views, cut_out_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> cameras = orbit_cameras(field, frames=2, width=16, height=12)
    >>> pictures = [render_field(field, camera, background=None).pixels for camera in cameras.cameras]
    >>> for picture in pictures:
    ...     picture[..., 3] = 255
    >>> alone = cut_out_field(build_views(cameras, pictures, scenery="keep"), field)
    >>> alone.masked, alone.scenery, int(alone.pictures[0][0, 0, 3])
    (True, False, 0)
    """
    kept, packed = [], []
    for number, camera in progress.each(list(enumerate(views.cameras.cameras))):
        alpha = np.where(views.used(number), render_field(field, camera).alpha, np.float32(0))
        if not (255 * alpha >= _SEEN).any():
            continue
        picture = views.pictures[number].copy()
        picture[..., 3] = np.rint(255 * alpha)
        kept.append(number)
        packed.append(PackedPicture(picture))
    if not kept:
        raise InvalidScene(Problem("the field", "is in none of the photographs", "a part of what they show"))
    pictures = PackedPictures(packed)
    return replace(views.take(kept), pictures=pictures, background=WHITE, masked=True, scenery=False, rough=True)
