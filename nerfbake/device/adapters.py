"""The graphics adapters of this machine, and the choice of one by its name."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfbake.device import library
from nerfbake.errors import DeviceError, Problem, UsageError
from nerfbake.installation import require_installed

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu

AUTO, CPU, GPU = "auto", "cpu", "gpu"
Kind = Literal["discrete", "integrated", "virtual", "software"]
_KINDS: dict[str, Kind] = {
    "DiscreteGPU": "discrete",
    "IntegratedGPU": "integrated",
    "Unknown": "virtual",  # wgpu's name for the card of a virtual machine
    "CPU": "software",
}
_SOFTWARE = ("llvmpipe", "swiftshader", "basic render")  # the last one is WARP; some drivers do not tell the kind
_ORDER: list[Kind] = ["discrete", "integrated", "virtual", "software"]
# Compute shaders through OpenGL have fewer buffers, and a card appears there a second time.
_BACKENDS = ("Vulkan", "Metal", "D3D12")
# NVIDIA's driver, and that of Windows in its Linux; other drivers have a file in /dev/dri.
_CARDS = ("/dev/nvidiactl", "/dev/dxg")


@dataclass(frozen=True)
class Adapter:
    """A graphics adapter. WebGPU does not tell how much memory it has, but the largest buffers.

    name            of the card, as its driver tells it
    kind            software: it computes on the CPU (lavapipe, SwiftShader, WARP)
    backend         Vulkan, Metal or D3D12
    driver          name and version
    largest_buffer  bytes
    largest_binding bytes that a shader can read through one binding
    """

    name: str
    kind: Kind
    backend: str
    driver: str
    largest_buffer: int
    largest_binding: int

    @property
    def is_card(self) -> bool:
        return self.kind != "software"


def list_adapters() -> tuple[Adapter, ...]:
    """The adapters of this machine, cards first; none if wgpu is not installed. Raises DeviceError."""
    return tuple(adapter for adapter, _ in _found()) if library.is_available() else ()


def open_device(device: str = AUTO) -> Gpu | None:
    """Return a device, or None for the CPU.

    device  auto: the first card, or None; cpu: None; gpu: the first card; else a part of an adapter's name. Software
            adapters are slower than the CPU itself, and are used only if they are named

    Raises UsageError if there is no such device, DeviceError if its driver fails.
    """
    if device == CPU or (device == AUTO and not (may_have_card() and library.is_available())):
        return None
    try:
        adapter = _chosen(device)
        return None if adapter is None else _opened(*adapter)
    except DeviceError:
        if device == AUTO:  # the CPU does the same work
            return None
        raise


def may_have_card() -> bool:
    """Whether this machine may have a graphics card, without loading a driver, which takes a second.

    Linux has a file for every card; other systems are asked through the driver.
    """
    if sys.platform != "linux":
        return True
    return any(Path(file).exists() for file in _CARDS) or any(Path("/dev/dri").glob("renderD*"))


def _chosen(name: str) -> tuple[Adapter, Any] | None:
    require_installed(library.MODULE, f"`device={name:.40}`")
    found = _found()
    cards = [each for each in found if each[0].is_card]
    if name in (AUTO, GPU):
        if cards:
            return cards[0]
        if name == AUTO:
            return None
        software = ", ".join(adapter.name.split(" (")[0] for adapter, _ in found)
        allowed = f"a graphics card, or `device={found[0][0].name.split()[0]}`" if found else "a graphics card"
        raise UsageError(Problem("`device`", f"is gpu, but there is {_only(software)}", f"{allowed}; cpu"))
    for adapter in found:
        if name.lower() in adapter[0].name.lower():
            return adapter
    names = ", ".join(adapter.name for adapter, _ in found)
    raise UsageError(Problem("`device`", f"is {name!r:.40}", ", ".join(filter(None, ("auto, cpu, gpu", names)))))


def _only(software: str) -> str:
    if software:
        return f"only the software adapter {software}, which is slower than the CPU's own code"
    return "no adapter with Vulkan, Metal or D3D12"


def _found() -> list[tuple[Adapter, Any]]:
    """The adapters and wgpu's objects for them."""
    wgpu = library.load()
    with library.quiet("the graphics driver"):
        found = [(_described(each), each) for each in wgpu.gpu.enumerate_adapters_sync()]
    found = [each for each in found if each[0].backend in _BACKENDS]
    return sorted(found, key=lambda each: _ORDER.index(each[0].kind))


def _described(adapter: Any) -> Adapter:
    info, limits = adapter.info, adapter.limits
    software = any(name in info["device"].lower() for name in _SOFTWARE)
    return Adapter(
        name=info["device"],
        kind="software" if software else _KINDS.get(info["adapter_type"], "virtual"),
        backend=info["backend_type"],
        driver=info["description"],
        largest_buffer=limits["max-buffer-size"],
        largest_binding=min(limits["max-storage-buffer-binding-size"], limits["max-buffer-size"]),
    )


def _opened(adapter: Adapter, handle: Any) -> Gpu:
    from nerfbake.device.gpu import Gpu

    return Gpu(adapter.name, handle)
