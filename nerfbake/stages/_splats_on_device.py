"""Splats in the memory of a graphics card, and their pictures. The shaders are shaders/splat/*.wgsl.

The CPU sorts the splats by depth, in float64 as for its own pictures. Equal depths are usual, because the splats of a
field lie on a grid; in the card's float32 they would not be equal, and their order would be another one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.device.gpu import Bound, Buffer, Dispatch, Download, Gpu
from nerfbake.device.shader_files import read_wgsl
from nerfbake.device.sorting import ENTRY, Sort, scan_on, sort_on
from nerfbake.errors import DeviceError, Problem
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.maths.affine import length, rotate
from nerfbake.kernels.splat.project import order_by_depth
from nerfbake.kernels.splat.tiles import EDGE, TileBoxes, bent_tiles, even_tiles
from nerfbake.scene.image import Image
from nerfbake.scene.splats import Splats
from nerfbake.stages._eye import eye_of
from nerfbake.stages._field_on_device import PIXEL_FLOATS, View, planes_of

_GROUP = 64  # threads
_WIDEST = 1 << 13  # pixels across the scene, from where float32 is too coarse: a place has 1/1000 of a pixel
_ENTRIES, _LEAST_ENTRIES = 4, 1 << 12  # room for entries of tiles, of a splat and of all, until a picture has more
_SPARE = 1.25  # of the room that a picture needs, so that the next one has it, too
_SPLAT_BYTES = 80  # on the CPU, while splats are arranged for the device

_PASSES = "project", "spread"  # a thread for each splat
_SHADERS = {
    "project": ("wgsl/harmonics", "splat/view", "splat/tiles", "splat/project"),
    "spread": ("splat/view", "splat/tiles", "splat/spread"),
    "blend": ("splat/view", "splat/blend"),
}

# The record `View` of view.wgsl.
_VIEW = np.dtype(
    [("turn", "<f4", (3, 4))]
    + [(name, "<f4", 4) for name in ("anchor", "away", "optics", "limits", "bounds", "squares", "products")]
    + [("background", "<f4", 4)]
    + [(name, "<u4") for name in ("width", "height", "columns", "rows", "begin", "end", "count", "total", "room")]
    + [(name, "<u4") for name in ("coefficients", "antialiased", "bent")]
)


class _Picture(NamedTuple):
    """What a picture needs on the device. order: of the splats; buffers: those of a bent lens."""

    view: View
    record: npt.NDArray[np.void]
    order: npt.NDArray[np.int32]
    tiles: TileBoxes
    buffers: dict[str, Buffer]

    @property
    def floats(self) -> int:
        return PIXEL_FLOATS * self.view.camera.width * self.view.camera.height


class SplatsOnDevice:
    """Splats on a device. Raises DeviceError if they do not fit there."""

    def __init__(self, gpu: Gpu, splats: Splats) -> None:
        splats.require_usable()
        n = splats.n
        self._gpu, self._n, self._means, self._record = gpu, n, splats.means, np.zeros((), _VIEW)
        self._record["total"], self._record["coefficients"] = n, splats.B
        self._record["antialiased"] = splats.antialiased
        self._box = np.stack([splats.means.min(axis=0), splats.means.max(axis=0)]).astype(np.float64)
        nothing = gpu.empty(16)
        self._buffers = {
            "sh": gpu.upload(splats.sh, f"the colours of {n:,} splats"),
            "solids": self._upload_solids(splats),
            "rows": gpu.empty(64 * n, f"the places of {n:,} splats in a picture"),
            "order": gpu.empty(4 * n),
            "counts": gpu.empty(4 * (n + 1)),
            "boxes": nothing,
            "places": nothing,
        }
        self._buffers["firsts"] = self._buffers["counts"]  # before the scan, and after it
        self._out, self._sort = nothing, Sort(0, 0, nothing, nothing, [])
        self._scan = scan_on(gpu, self._buffers["counts"], n + 1)

    @property
    def _most(self) -> int:
        """The most entries of a picture, or of rows of its tiles."""
        return self._gpu.limits.binding // ENTRY

    def _upload_solids(self, splats: Splats) -> Buffer:
        with memory.lent("the splats on their way to the device", _SPLAT_BYTES * splats.n):
            solids = np.zeros((splats.n, 3, 4), np.float32)
            solids[:, 0, :3], solids[:, 0, 3] = splats.means, splats.opacity
            solids[:, 1, :3], solids[:, 2] = splats.scales, splats.quats
            return self._gpu.upload(solids, f"the shapes of {splats.n:,} splats")

    def suits(self, view: View) -> bool:
        """Whether float32 is fine enough for how far the camera zooms."""
        camera = view.camera
        away = length(camera.pose[:3, 3] - self._anchor(camera.pose[:3, 3]))
        share = min(length(self._box[1] - self._box[0]) / away, 1.0) if away else 1.0
        return max(camera.fx, camera.fy) * share <= _WIDEST

    def start(self, view: View) -> Callable[[], Image]:
        """Start the work of a picture; the result waits for it and returns the picture. Both raise DeviceError."""
        view.camera.require_memory(2 * 4 * PIXEL_FLOATS)
        picture = self._prepared(view)
        room = self._submit(picture, 0, picture.tiles.rows)
        download = self._gpu.read_later(self._out, np.float32, picture.floats)
        total = self._read_total()

        def take() -> Image:
            met = int(total.take()[0])
            found = download.take()
            if met > room:
                found = self._made_again(picture, met)
            return Image(*planes_of(found, view.camera.width, view.camera.height), view.background)

        return take

    def _made_again(self, picture: _Picture, met: int) -> Singles:
        """Make a picture with more room, in ranges of rows of tiles that have room. met: its entries."""
        ranges = [(0, picture.tiles.rows)]
        while ranges:
            begin, end = ranges.pop()
            self._make_room(picture, met)
            room = self._submit(picture, begin, end)
            met = int(self._read_total().take()[0])
            if met <= room:
                continue
            if room < self._most:
                ranges.append((begin, end))
            elif end - begin > 1:
                middle = (begin + end) // 2
                ranges += [(begin, middle), (middle, end)]
            else:
                found = f"need room for {met:,} entries"
                raise DeviceError(Problem("the splats of a row of tiles", found, f"{room:,} on {self._gpu.name}"))
        return self._gpu.read(self._out, np.float32, picture.floats)

    def _make_room(self, picture: _Picture, met: int) -> None:
        """Make the buffers of entries large enough for a picture with so many, if they can be."""
        room, bits = min(met, self._most), (picture.tiles.rows * picture.tiles.columns).bit_length()
        if room > self._sort.room or bits > self._sort.bits:
            room, bits = max(min(int(_SPARE * room), self._most), self._sort.room), max(bits, self._sort.bits)
            self._sort = sort_on(self._gpu, self._buffers["firsts"], self._n, room=room, bits=bits)

    def _submit(self, picture: _Picture, begin: int, end: int) -> int:
        """Start the work of a range of rows of tiles. Returns for how many entries there is room."""
        self._make_room(picture, max(_ENTRIES * self._n, _LEAST_ENTRIES) if not self._sort.room else 0)
        if self._out.size < 4 * picture.floats:
            self._out = self._gpu.empty(4 * picture.floats, "a picture")
        gpu, sort, tiles = self._gpu, self._sort, picture.tiles
        gpu.write(self._buffers["order"], picture.order)
        record = picture.record.copy()
        record["begin"], record["end"], record["room"] = begin, end, sort.room
        shared = {**self._buffers, **picture.buffers, "view": gpu.upload_records(record.reshape(1)), "out": self._out}
        # All rows are counted, also those that `order` does not have.
        threads = -(-(self._n + 1) // _GROUP)
        project, spread = (Dispatch(self._bound(name, {**shared, "entries": sort.source}), threads) for name in _PASSES)
        blend = Dispatch(self._bound("blend", {**shared, "entries": sort.sorted}), (end - begin) * tiles.columns)
        gpu.submit([project, *self._scan, spread, *sort.work, blend])
        return sort.room

    def _bound(self, name: str, buffers: dict[str, Buffer]) -> Bound:
        return self._gpu.bind(self._gpu.pipeline(read_wgsl(*_SHADERS[name]), name), buffers)

    def _read_total(self) -> Download:
        """The number of entries of what was submitted last."""
        return self._gpu.read_later(self._buffers["firsts"], np.uint32, 1, 4 * self._n)

    def _anchor(self, place: Floats) -> Floats:
        """The point of the scene's box that is nearest to a place, as the shader has it."""
        return np.clip(place, *self._box).astype(np.float32).astype(np.float64)

    def _prepared(self, view: View) -> _Picture:
        """Place a picture's camera, and sort the splats by depth."""
        camera = view.camera
        eye, places = eye_of(camera)
        anchor, record, own = self._anchor(eye.origin), self._record.copy(), dict[str, Buffer]()
        away = anchor - eye.origin
        record["turn"][:, :3], record["turn"][:, 3] = eye.turn, rotate(away, eye.turn)
        record["anchor"][:3], record["away"][:3] = anchor, away
        record["optics"] = eye.fx, eye.fy, eye.cx, eye.cy
        record["limits"], record["bounds"] = eye.limits, eye.bounds
        record["squares"][:3] = eye.gram.diagonal()
        record["products"][:3] = eye.gram[[0, 0, 1], [1, 2, 2]]
        if view.background is not None:
            record["background"][:3] = view.background
        tiles = bent_tiles(places) if len(places) else even_tiles(camera.width, camera.height)
        if len(places):
            corners = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1) // EDGE * EDGE
            own["boxes"] = self._gpu.upload(np.concatenate([tiles.bands, tiles.boxes]).astype(np.float32))
            own["places"] = self._gpu.upload((places - corners).astype(np.float32), "the places of pixels")
        order = order_by_depth(self._means, eye)
        record["width"], record["height"] = camera.width, camera.height
        record["columns"], record["rows"] = tiles.columns, tiles.rows
        record["count"], record["bent"] = len(order), len(places) > 0
        return _Picture(view, record, order, tiles, own)
