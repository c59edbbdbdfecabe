"""What renders radiance fields and splats: the kernels of the CPU, or a graphics card.

A job chooses once, stages receive it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from nerfbake.device.gpu import Gpu
from nerfbake.errors import DeviceError
from nerfbake.scene.camera import Camera, require_samples
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.octree import Lookup
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.stages._field_on_device import FieldOnDevice, View
from nerfbake.stages._splats_on_device import SplatsOnDevice
from nerfbake.stages.field_to_image import render_field, require_options
from nerfbake.stages.splats_to_image import render_splats

Rendered = RadianceField | Splats
Tell = Callable[[str], None]


class Renderer(Protocol):
    """Renders fields like render_field() and splats like render_splats(), with the same options."""

    def __call__(self, scene: Rendered, camera: Camera, **options: Any) -> Image:
        """Return the picture of a camera."""

    def each(self, scene: Rendered, cameras: Iterable[Camera], **options: Any) -> Iterator[Image]:
        """Yield the pictures of several cameras, rendered on demand."""


class KernelRenderer:
    """Renders with the kernels of the CPU: the same bytes on every CPU."""

    def __call__(self, scene: Rendered, camera: Camera, **options: Any) -> Image:
        if isinstance(scene, Splats):
            return render_splats(scene, camera, **options)
        return render_field(scene, camera, **options)

    def each(self, scene: Rendered, cameras: Iterable[Camera], **options: Any) -> Iterator[Image]:
        return (self(scene, camera, **options) for camera in cameras)


KERNELS: Renderer = KernelRenderer()


class DeviceRenderer:
    """Renders on a device, with float32: pictures differ from those of the CPU by less than 1/255.

    A scene stays in the device's memory as long as it exists. What the device cannot do, and everything after an error
    of the device, is rendered by the CPU. tell: is called with one line then, and for the first scene.
    """

    def __init__(self, gpu: Gpu, tell: Tell) -> None:
        self._gpu: Gpu | None = gpu
        self._tell, self._named, self._told = tell, False, False
        self._scenes: WeakKeyDictionary[Rendered, FieldOnDevice | SplatsOnDevice | None] = WeakKeyDictionary()

    def __call__(self, scene: Rendered, camera: Camera, **options: Any) -> Image:
        return self._start(scene, camera, options)()

    def each(self, scene: Rendered, cameras: Iterable[Camera], **options: Any) -> Iterator[Image]:
        """The device renders the next picture while the caller has the last one."""
        waiting: Callable[[], Image] | None = None
        for camera in cameras:
            started = self._start(scene, camera, options)
            if waiting is not None:
                yield waiting()
            waiting = started
        if waiting is not None:
            yield waiting()

    def _start(self, scene: Rendered, camera: Camera, options: dict[str, Any]) -> Callable[[], Image]:
        """Start the work of a picture. The result waits for it and returns the picture."""
        if isinstance(scene, Splats):
            view = _view_of_splats(scene, camera, **options)
        else:
            view = _view_of(scene, camera, **options)
        placed = self._placed(scene)

        def on_cpu() -> Image:
            return KERNELS(scene, camera, **options)

        if placed is None or not placed.suits(view):
            return on_cpu
        try:
            take = placed.start(view)
        except DeviceError as error:
            self._lose(error)
            return on_cpu

        def finish() -> Image:
            try:
                return take()
            except DeviceError as error:
                self._lose(error)
                return on_cpu()

        return finish

    def _placed(self, scene: Rendered) -> FieldOnDevice | SplatsOnDevice | None:
        """The scene on the device; None if it does not fit."""
        if self._gpu is None:
            return None
        if scene not in self._scenes:
            try:
                if isinstance(scene, Splats):
                    self._scenes[scene] = SplatsOnDevice(self._gpu, scene)
                else:
                    self._scenes[scene] = FieldOnDevice(self._gpu, scene)
                if not self._named:
                    self._tell(f"renders on {self._gpu.name}")
                self._named = True
            except DeviceError as error:
                self._say(error)
                self._scenes[scene] = None
        return self._scenes[scene]

    def _lose(self, error: DeviceError) -> None:
        """Render everything from now on with the CPU."""
        self._say(error)
        self._gpu = None
        self._scenes.clear()

    def _say(self, error: DeviceError) -> None:
        if not self._told:
            self._tell(f"{error.line}; the CPU renders instead")
        self._told = True


def _view_of(
    field: RadianceField,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
    lookup: Lookup = "nearest",
    stop: npt.NDArray[np.float64] | None = None,
    samples: int = 1,
) -> View:
    require_options(field, camera, transmittance_cut, lookup, stop, samples)
    return View(camera, background, transmittance_cut, lookup, stop, samples)


def _view_of_splats(
    splats: Splats, camera: Camera, *, background: tuple[float, float, float] | None = WHITE, samples: int = 1
) -> View:
    require_samples(samples)
    splats.require_usable()
    return View(camera, background, 0.0, "nearest", None, samples)
