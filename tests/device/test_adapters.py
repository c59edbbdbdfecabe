"""Which adapter a name chooses, and what is said where there is none."""

from __future__ import annotations

import os

import pytest

from nerfbake.device import adapters, library
from nerfbake.device.adapters import Adapter, Kind, list_adapters, open_device
from nerfbake.errors import DeviceError, NerfbakeError, UsageError
from tests.support.device import software


def made(name: str, kind: Kind) -> Adapter:
    return Adapter(name, kind, "Vulkan", "driver 1", 1 << 31, 1 << 27)


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch) -> list[Adapter]:
    """The adapters of a machine. They open as themselves."""
    found: list[Adapter] = []
    monkeypatch.setattr(adapters, "_found", lambda: [(each, None) for each in found])
    monkeypatch.setattr(adapters, "_opened", lambda adapter, _: adapter)
    monkeypatch.setattr("nerfbake.installation.is_installed", lambda _: True)
    monkeypatch.setattr(library, "is_available", lambda: True)
    monkeypatch.setattr(adapters, "may_have_card", lambda: True)
    return found


@pytest.mark.parametrize(
    ("name", "chosen"),
    [
        ("auto", "Radeon 780M"),
        ("gpu", "Radeon 780M"),
        ("cpu", None),
        ("pipe", "llvmpipe (256 bits)"),
        ("radeon", "Radeon 780M"),
    ],
)
def test_a_name_chooses_an_adapter(present: list[Adapter], name: str, chosen: str | None) -> None:
    present += [made("Radeon 780M", "integrated"), made("llvmpipe (256 bits)", "software")]
    opened = open_device(name)
    assert (None if opened is None else opened.name) == chosen


def test_a_software_adapter_is_used_only_if_it_is_named(present: list[Adapter]) -> None:
    present += [made("llvmpipe (256 bits)", "software")]
    assert open_device("auto") is None
    with pytest.raises(UsageError) as raised:
        open_device("gpu")
    assert raised.value.line == (
        "--device is gpu, but there is only the software adapter llvmpipe, which is slower than the CPU's own code; "
        "allowed: a graphics card, or --device llvmpipe; cpu"
    )


@pytest.mark.parametrize(
    ("name", "told", "kind"),
    [
        ("NVIDIA H200", "DiscreteGPU", "discrete"),
        ("Apple M4", "IntegratedGPU", "integrated"),
        ("Virtio-GPU Venus", "Unknown", "virtual"),
        ("llvmpipe (LLVM 15.0.6)", "CPU", "software"),
        ("Google SwiftShader", "Unknown", "software"),
        ("Microsoft Basic Render Driver", "IntegratedGPU", "software"),
    ],
)
def test_the_kind_of_an_adapter_is_told_by_its_driver_or_its_name(name: str, told: str, kind: str) -> None:
    class Handle:
        info = {"device": name, "adapter_type": told, "backend_type": "Vulkan", "description": "driver 1"}  # noqa: RUF012
        limits = {"max-buffer-size": 1 << 31, "max-storage-buffer-binding-size": 1 << 27}  # noqa: RUF012

    assert adapters._described(Handle()).kind == kind


def test_a_machine_without_adapters_says_so(present: list[Adapter]) -> None:
    assert open_device("auto") is None
    with pytest.raises(
        UsageError, match="there is no adapter with Vulkan, Metal or D3D12; allowed: a graphics card; cpu"
    ):
        open_device("gpu")
    with pytest.raises(UsageError, match=r"is 'x'; allowed: auto, cpu, gpu$"):
        open_device("x")


def test_without_wgpu_auto_is_the_cpu_and_gpu_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.installation.is_installed", lambda _: False)
    monkeypatch.setattr(library, "is_available", lambda: False)
    assert open_device("auto") is None
    assert list_adapters() == ()
    for name in ("gpu", "llvmpipe"):
        with pytest.raises(
            NerfbakeError, match=r"needs wgpu, which is not installed; allowed: .*nerfbake\[gpu\]|\[gpu\]"
        ):
            open_device(name)


def test_a_driver_that_fails_is_the_cpu_for_auto_alone(present: list[Adapter], monkeypatch: pytest.MonkeyPatch) -> None:
    present += [made("Radeon 780M", "integrated")]

    def fail(*_: object) -> None:
        raise DeviceError("Radeon 780M: out of memory")

    monkeypatch.setattr(adapters, "_opened", fail)
    assert open_device("auto") is None
    with pytest.raises(DeviceError, match="out of memory"):
        open_device("gpu")


def test_a_real_driver_is_listed_in_silence(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    name = software()
    assert [adapter.kind for adapter in list_adapters() if adapter.name == name] == ["software"]
    assert capfd.readouterr() == ("", "")
    assert "XDG_RUNTIME_DIR" not in os.environ


def test_a_forked_process_does_not_use_the_driver_of_its_parent() -> None:
    software()
    if (child := os.fork()) == 0:
        try:
            library.load()
        except DeviceError:
            os._exit(0)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
