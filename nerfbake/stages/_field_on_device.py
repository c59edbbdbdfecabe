"""A radiance field in the memory of a graphics card, and its pictures. The shader is shaders/device/render.wgsl."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.device.gpu import Buffer, Dispatch, Download, Gpu, Pipeline
from nerfbake.device.shader_files import read_wgsl
from nerfbake.errors import DeviceError
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.maths.affine import inverse, rotate, transform_points
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import Image
from nerfbake.scene.octree import Lookup
from nerfbake.scene.page import texels_of
from nerfbake.scene.radiance_field import RadianceField

_RAYS = 1 << 20  # rays of one submit: a few milliseconds on a card, and a driver stops what takes seconds
_TILE = 8  # pixels along an edge of a workgroup
_LEVELS = 32  # levels of a tree in a record of the shader
_LEVEL_BITS = 6  # of an entry of Cells.top: its level
_FARTHEST = 1 << 14  # cells from a bent camera to the box, beyond which float32 is too coarse
PIXEL_FLOATS = 5  # colour, alpha and depth
_ROWS = 1 << 16  # rows of values that are arranged at a time

# A record of the shader, in the layout of WGSL.
_VIEW = np.dtype(
    [(name, "<f4", 4) for name in ("eye", "right", "up", "forward")]
    + [("turn", "<f4", (3, 4))]
    + [(name, "<f4", 4) for name in ("norm", "low", "high", "background")]
    + [(name, "<i4", 4) for name in ("anchor", "first", "last")]
    + [(name, "<u4", 4) for name in ("size", "has", "tree")]
    + [("levels", "<i4", (_LEVELS, 4))]
)


class View(NamedTuple):
    """A picture to render. See render_field()."""

    camera: Camera
    background: tuple[float, float, float] | None
    cut: float
    lookup: Lookup
    stop: npt.NDArray[np.float64] | None
    samples: int


class FieldOnDevice:
    """A field on a device. Raises DeviceError if it does not fit there."""

    def __init__(self, gpu: Gpu, field: RadianceField) -> None:
        cells, B = field.cells, field.basis.size
        if cells.radix or len(cells.first) > _LEVELS:
            raise DeviceError("the shader reads trees whose nodes have 2, 4, 8, ... cells along an edge")
        self._gpu, self._texels = gpu, texels_of(field.basis)
        self._functions = 0 if field.basis.kind == "RGBA" else B
        top = np.stack([cells.top >> _LEVEL_BITS, cells.top & (1 << _LEVEL_BITS) - 1], axis=1).astype(np.int32)
        nothing = gpu.empty(4)
        self._buffers = {
            "slots": gpu.upload(cells.slots, "the tree of the field"),
            "top": gpu.upload(top, "the grid of the field"),
            "texels": self._upload_values(field),
            "stops": nothing,
            "looks": nothing,
        }
        self._out = nothing
        # Of the field, all that the records of its pictures share.
        self._place, self._box, self._record = field.place, field.box, np.zeros((), _VIEW)
        self._record["turn"][:, :3] = field.place[:, :3]
        self._record["norm"][:3] = 1 / np.linalg.norm(field.place[:, :3], axis=1)
        self._record["tree"][:3] = cells.top_bits, cells.top_below, cells.edge
        for level, (first, bits, shift) in enumerate(zip(cells.first, cells.bits, cells.shift, strict=True)):
            self._record["levels"][level, :3] = first, bits, shift
        around = field.box + np.array([[-0.5], [0.5]])  # interpolation reaches half a cell further
        self._corners = field.world(np.array(np.meshgrid(*around.T)).reshape(3, -1).T)

    def _upload_values(self, field: RadianceField) -> Buffer:
        B, T, rows = field.basis.size, self._texels, len(field.values)
        texels = self._gpu.empty(16 * T * rows, f"the values of {rows:,} cells")
        with memory.lent("the values on their way to the device", 16 * T * min(rows, _ROWS)):
            for first in range(0, rows, _ROWS):
                some = field.values[first : first + _ROWS]
                flat = np.zeros((len(some), 4 * T), np.float32)
                for channel in range(3):
                    flat[:, channel] = some[:, channel * B]
                    flat[:, 4 + channel : 4 + 3 * (B - 1) : 3] = some[:, channel * B + 1 : (channel + 1) * B]
                flat[:, 3] = some[:, -1]
                self._gpu.write(texels, flat, 16 * T * first)
        return texels

    def suits(self, view: View) -> bool:
        """Whether float32 is fine enough. The rays of a lens start at the camera, which must not be far away."""
        place = transform_points(view.camera.pose[:3, 3], self._place)
        away = np.abs(place - np.clip(place, *self._box)).max()
        return not view.camera.bends or bool(away <= _FARTHEST)

    def start(self, view: View) -> Callable[[], Image]:
        """Start the work of a picture; the result waits for it and returns the picture. Both raise DeviceError."""
        width, height = view.camera.width, view.camera.height
        view.camera.require_memory(2 * 4 * PIXEL_FLOATS)
        parts = [(rows, self._start_part(view, rows)) for rows in _stripes(width, height, view.samples)]

        def take() -> Image:
            pieces = [planes_of(download.take(), width, rows.stop - rows.start) for rows, download in parts]
            colour, alpha, depth = pieces[0] if len(pieces) == 1 else map(np.concatenate, zip(*pieces, strict=True))
            return Image(colour, alpha, depth, view.background)

        return take

    def _start_part(self, view: View, rows: slice) -> Download:
        """Start the work of some rows of pixels."""
        width, height = view.camera.width, rows.stop - rows.start
        count, tiles = width * height, (-(-width // _TILE), -(-height // _TILE))
        buffers = dict(self._buffers)
        if self._out.size < 4 * PIXEL_FLOATS * count:
            self._out = self._gpu.empty(4 * PIXEL_FLOATS * count, "a picture")
        record = self._record_of(view, view.camera.part(slice(0, width), rows), tiles[0])
        if view.stop is not None:
            buffers["stops"] = self._gpu.upload(np.minimum(view.stop[rows], 3e38).astype(np.float32), "distances")
        if view.camera.bends:
            looks = view.camera.part(slice(0, width), rows, finer=view.samples).rays()[1]
            buffers["looks"] = self._gpu.upload(looks.astype(np.float32), "directions")
        buffers |= {"out": self._out, "view": self._gpu.upload_records(record.reshape(1))}
        bound = self._gpu.bind(self._pipeline(view.lookup), buffers)
        self._gpu.submit([Dispatch(bound, tiles[0] * tiles[1])])
        return self._gpu.read_later(self._out, np.float32, PIXEL_FLOATS * count)

    def _pipeline(self, lookup: Lookup) -> Pipeline:
        constants = {"BASIS": self._functions, "TEXELS": self._texels, "SMOOTH": lookup == "trilinear"}
        return self._gpu.pipeline(read_wgsl("wgsl/harmonics", "device/render"), "render", constants)

    def _record_of(self, view: View, camera: Camera, tiles: int) -> npt.NDArray[np.void]:
        """The record of a picture of this camera."""
        right, up, back = camera.pose[:3, :3].T
        box, shift = self._box, 0.0
        if view.lookup == "trilinear":
            # Positions count from cell centres, and the box extends to the next centre on each side.
            box, shift = box + np.array([[-1], [0]]), 0.5
        first, last = np.floor(box[0]).astype(np.int64), np.ceil(box[1]).astype(np.int64) - 1
        depth = 0.0 if camera.bends else self._depth_before(camera)
        start = transform_points(camera.pose[:3, 3] - depth * back, self._place) - shift
        anchor = np.clip(np.floor(start), first, last).astype(np.int64)
        record = self._record.copy()
        record["eye"][:] = *(start - anchor), depth
        record["right"][:] = *right, camera.fx
        record["up"][:] = *up, camera.fy
        record["forward"][:] = *-back, camera.cx
        record["turn"][0, 3], record["norm"][3] = camera.cy, view.cut
        record["low"][:3], record["high"][:3] = box - anchor
        if view.background is not None:
            record["background"][:] = *view.background, 1
        record["anchor"][:3], record["first"][:3], record["last"][:3] = anchor, first, last
        record["size"][:] = camera.width, camera.height, view.samples, tiles
        record["has"][:2] = view.stop is not None, camera.bends
        return record

    def _depth_before(self, camera: Camera) -> float:
        """The depth of a plane between the camera and the box, 0 if the camera is inside or beside it.

        From there on positions are as small as the box, however far away the camera is.
        """
        seen = rotate(self._corners - camera.pose[:3, 3], inverse(camera.pose[:3, :3]))
        return max(0.0, float(-seen[:, 2].max()))


def _stripes(width: int, height: int, samples: int) -> list[slice]:
    """The rows of pixels of each submit."""
    rows = max(1, _RAYS // (width * samples * samples))
    return [slice(first, min(first + rows, height)) for first in range(0, height, rows)]


def planes_of(found: Singles, width: int, height: int) -> tuple[Singles, Singles, Singles]:
    """Return colour (H, W, 3), alpha and depth (H, W) of what a shader wrote."""
    count = width * height
    colour, alpha, depth = found[: 3 * count], found[3 * count : 4 * count], found[4 * count :]
    return colour.reshape(height, width, 3), alpha.reshape(height, width), depth.reshape(height, width)
