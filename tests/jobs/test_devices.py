"""--device: what it chooses, what it says, and that the pictures are those of the CPU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import Image, build_octree, load, sample_n3tree, save
from nerfbake.cli import main
from nerfbake.device import adapters
from nerfbake.device.adapters import Adapter
from nerfbake.errors import UsageError
from nerfbake.jobs import devices
from nerfbake.jobs.devices import describe_devices, renderer_on
from nerfbake.stages.renderers import KERNELS
from tests.support.device import software
from tests.support.splats import ball_of_splats


@pytest.fixture(autouse=True)
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.npz", sample_n3tree(resolution=8))


@pytest.fixture
def one_card(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Adapter("Card 1", "discrete", "Vulkan", "driver 5", 1 << 32, 1 << 31),
        Adapter("llvmpipe", "software", "Vulkan", "Mesa", 1 << 31, 1 << 27),
    ]
    monkeypatch.setattr(adapters, "_found", lambda: [(each, None) for each in found])


def test_this_machine_has_its_kernels() -> None:
    assert renderer_on("cpu") is KERNELS


@pytest.mark.slow
def test_a_named_device_renders_what_the_cpu_renders(capsys: pytest.CaptureFixture[str]) -> None:
    name = software()
    for device, out in (("cpu", "cpu"), (name, "device")):
        line = ["render", "a.npz", "--out", out, "--turntable", "2", "--size", "30x20", "--device", device]
        assert main.run(line) == 0
    said = capsys.readouterr().err.splitlines()
    assert said.count(f"renders on {name}") == 1
    for number in range(2):
        found, wanted = (load(f"{out}/{number:04}.png", Image).colour for out in ("device", "cpu"))
        assert np.abs(found - wanted).max() < 1.5 / 255
        assert wanted.std() > 0.05


@pytest.mark.parametrize(
    "line",
    [
        "compare a.npz a.npz --size 16x16",
        "compress a.npz OUT.svoq",
        "lod a.svo.pb OUT.svo.pb --level 2 --min-psnr 30",
        "mesh a.npz OUT.ply --frames 2 --edge 16",
        "refit a.svo.pb OUT.svo.pb --like a.npz --frames 2 --edge 16",
        "render a.npz --out OUT.png",
        "render a.npz --out OUT.png --mesh a.obj",
        "splats a.npz OUT.ply --frames 2 --edge 16",
        "svo a.npz OUT.svo.pb --min-psnr 30",
        "view a.npz OUT.html --data exact",
        "compare a.ply a.ply --size 16x16",
        "render a.ply --out OUT.png",
        "splats a.ply OUT.ply --count 5 --frames 2 --edge 16",
        "splats a.ply OUT.spz --edge 16",
        "view a.ply OUT.html --as splats",
    ],
)
def test_every_command_that_renders_a_field_or_splats_does_it_on_the_device(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Refusing:
        """Refuses to render, and names its device."""

        def __init__(self, gpu: str, tell: object) -> None:
            self.gpu = gpu

        def __call__(self, *_: object, **options: object) -> None:
            raise UsageError(f"asked to render on {self.gpu}")

        each = __call__

    monkeypatch.setattr(devices, "open_device", str)
    monkeypatch.setattr("nerfbake.jobs.refits.open_device", str)
    monkeypatch.setattr(devices, "DeviceRenderer", Refusing)
    save("a.svo.pb", build_octree(sample_n3tree(resolution=8)))
    save("a.ply", ball_of_splats(20))
    Path("a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert main.run([*line.split(), "--device", "Radeon", "-q"]) == 2
    assert capsys.readouterr().err.strip().endswith("asked to render on Radeon")


def test_a_card_that_is_not_there_is_one_line_before_anything_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    software()
    assert main.run(["render", "a.npz", "--out", "a.png", "--device", "gpu"]) == 2
    assert main.run(["render", "a.npz", "--out", "a.png", "--device", "Radeon"]) == 2
    gpu, other = capsys.readouterr().err.splitlines()
    assert gpu.startswith("error: --device is gpu, but there is only the software adapter llvmpipe")
    assert "allowed: auto, cpu, gpu, llvmpipe" in other
    assert not Path("a.png").exists()


@pytest.mark.usefixtures("one_card")
def test_adapters_are_described_with_what_fits(capsys: pytest.CaptureFixture[str]) -> None:
    card, pipe = describe_devices()
    assert (card["name"], card["default"], card["cells"]) == ("Card 1", True, (1 << 31) // 112)
    assert (pipe["name"], pipe["default"], pipe["cells"]) == ("llvmpipe", False, (1 << 27) // 112)
    assert main.run(["info", "--devices"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "Card 1",
        "  discrete, Vulkan, driver 5",
        "  renders fields of up to 19,173,961 cells with SH9 (buffers of 2.0 GiB)",
        "  used by default",
        "llvmpipe",
        "  software, Vulkan, Mesa",
        "  renders fields of up to 1,198,372 cells with SH9 (buffers of 128.0 MiB)",
        "  used with --device 'llvmpipe'; it computes on the CPU, slower than nerfbake itself",
    ]


def test_a_machine_without_adapters_or_without_wgpu_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(adapters, "_found", list)
    assert main.run(["info", "--devices"]) == 0
    monkeypatch.setattr("nerfbake.installation.find_spec", lambda _: None)
    assert main.run(["info", "--devices"]) == 0
    none, missing = capsys.readouterr().out.splitlines()
    assert none == "no graphics adapter"
    assert missing.startswith("no graphics adapter; to look for one: ")
    assert "[gpu]" in missing


def test_info_takes_a_file_or_asks_for_devices() -> None:
    assert main.run(["info"]) == 2
    assert main.run(["info", "a.npz", "--devices"]) == 2
