"""The choice of what renders fields and splats, made once by a job, and what there is to choose from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nerfbake.device.adapters import AUTO, list_adapters, open_device
from nerfbake.installation import command_for, is_installed
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.stages.renderers import KERNELS, DeviceRenderer, Renderer

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu

DEVICE = AUTO  # the default of every job
_CELL_BYTES = 4 * 28  # of a cell with SH9 and density


def describe_devices() -> list[dict[str, Any]]:
    """Return what `--device` can choose here: each graphics adapter, cards first.

    cells: of the largest field with SH9 that the adapter renders. default: `auto` chooses it. Raises DeviceError.
    """
    found = list_adapters()
    return [
        {
            "name": adapter.name,
            "kind": adapter.kind,
            "backend": adapter.backend,
            "driver": adapter.driver,
            "bytes_of_buffer": adapter.largest_binding,
            "cells": adapter.largest_binding // _CELL_BYTES,
            "default": adapter.is_card and adapter is found[0],
        }
        for adapter in found
    ]


def missing_library() -> str | None:
    """Return the command that installs what graphics cards need; None if it is installed."""
    return None if is_installed("wgpu") else command_for("wgpu")


def renderer_on(device: str = DEVICE, *, steps: Steps = SILENT) -> Renderer:
    """Return what renders fields and splats on a device. Prints the name of the card when it gets the first one.

    device  auto: a graphics card if there is one, else the CPU; cpu; gpu: a graphics card; or a part of an adapter's
            name

    If a card fails later, a line says so, and the CPU renders what is left. Raises UsageError if there is no such
    device.

    >>> type(renderer_on("cpu")).__name__
    'KernelRenderer'
    """
    return renderer_with(steps, open_device(device))


def renderer_with(steps: Steps, gpu: Gpu | None) -> Renderer:
    """Return what renders fields and splats on an open device, as renderer_on() does; None: the CPU."""
    return KERNELS if gpu is None else DeviceRenderer(gpu, steps.say)
