"""The choice of what renders fields, made once by a job."""

from __future__ import annotations

from nerfbake.device.adapters import AUTO as DEVICE
from nerfbake.device.adapters import open_device
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.stages.renderers import KERNELS, DeviceRenderer, Renderer


def renderer_on(device: str = DEVICE, *, steps: Steps = SILENT) -> Renderer:
    """Return what renders fields on a device. Prints the name of the card when it gets the first field.

    device  auto: a graphics card if there is one, else the CPU; cpu; gpu: a graphics card; or a part of an adapter's
            name

    If a card fails later, a line says so, and the CPU renders what is left. Raises UsageError if there is no such
    device.

    >>> renderer_on("cpu") is KERNELS
    True
    """
    gpu = open_device(device)
    if gpu is None:
        return KERNELS
    return DeviceRenderer(gpu, steps.say)
