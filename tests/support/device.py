"""A software adapter for tests, where Mesa's lavapipe is installed."""

from __future__ import annotations

import pytest

from nerfbake.device.adapters import list_adapters, open_device
from nerfbake.device.gpu import Gpu

DEBIAN = "Debian: mesa-vulkan-drivers"


def software() -> str:
    """The name of the software adapter. Skips the test if there is none."""
    pytest.importorskip("wgpu")
    found = [adapter.name for adapter in list_adapters() if not adapter.is_card]
    if not found:
        pytest.skip(f"no Vulkan on the CPU here ({DEBIAN})")
    return found[0]


def opened() -> Gpu:
    gpu = open_device(software())
    assert gpu is not None
    return gpu
