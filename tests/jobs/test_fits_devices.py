"""A fit on a graphics card: what is told, and what happens if the card fails."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nerfbake.errors import DeviceError, UsageError
from nerfbake.jobs import FitOptions, fit_file
from tests.jobs.fake_fit import FakeFit, fake_fit
from tests.jobs.listener import Listener
from tests.support.device import software
from tests.support.photographs import write_scene

CARD: Any = SimpleNamespace(name="A Card 5")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("capture") / "scene")


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeFit:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nerfbake.jobs.fits.open_device", lambda name: CARD if name == "gpu" else None)
    return fake_fit(monkeypatch)


def fail() -> None:
    raise DeviceError("A Card 5: waiting: the device is lost")


@pytest.mark.parametrize("step", [1, 6])
def test_if_the_card_fails_the_cpu_does_the_rest(
    trainer: FakeFit, capture: Path, listener: Listener, step: int
) -> None:
    trainer.at_step[step] = fail
    fitted = fit_file(capture, "a.npz", options=FitOptions(device="gpu"), steps=listener)
    assert [asked["gpu"] for asked in trainer.asked] == [CARD, None]
    done = trainer.asked[1]["start"]
    assert (done is None) == (step == 1)
    rest = "does all of the fit" if step == 1 else "goes on from stage 1, epoch 2"
    assert f"A Card 5: waiting: the device is lost; the CPU {rest}" in listener.said
    assert any(line.endswith("fits on A Card 5") for line in listener.said)
    assert fitted.device == "cpu"


def test_without_a_card_nothing_is_told(trainer: FakeFit, capture: Path, listener: Listener) -> None:
    fitted = fit_file(capture, "a.npz", steps=listener)
    assert trainer.asked[0]["gpu"] is None
    assert fitted.device == "cpu"
    assert not any("fits on" in line for line in listener.said)


def test_a_checkpoint_of_another_device_is_told(trainer: FakeFit, capture: Path, listener: Listener) -> None:
    def stop() -> None:
        raise RuntimeError("killed")

    def fit(device: str) -> None:
        fit_file(capture, "a.npz", options=FitOptions(device=device), state="state", steps=listener)

    for step in (8, 5):
        trainer.steps, trainer.at_step = 0, {step: stop}
        with pytest.raises(RuntimeError, match="killed"):
            fit("gpu")
    assert not any("other bytes" in line for line in listener.said)
    trainer.at_step = {}
    fit("cpu")
    assert "state/checkpoint.npz: is from A Card 5; with cpu the fit ends in other bytes" in listener.said


def test_minutes_are_those_of_the_card(trainer: FakeFit, capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.stages.fit_speed.measure_speed", lambda _: 10.0)
    monkeypatch.setattr("nerfbake.jobs.fits.measure_views", lambda *_, **__: (_ for _ in ()).throw(UsageError("stop")))
    epochs = []
    for device in "cpu", "gpu":
        with pytest.raises(UsageError, match="stop"):
            fit_file(capture, f"{device}.npz", options=FitOptions(minutes=1.0, device=device))
        epochs.append(trainer.asked[-1]["schedule"].epochs)
    assert epochs[1] > 3 * epochs[0]


@pytest.mark.long
def test_a_file_from_a_software_adapter_is_the_same_on_every_run(capture: Path, tmp_path: Path) -> None:
    options = FitOptions(epochs="cells=8,scale=2", basis="SH1", device=software())
    files = [tmp_path / name for name in ("a.npz", "b.npz")]
    for path in files:
        assert fit_file(capture, str(path), options=options).device == options.device
    assert files[0].read_bytes() == files[1].read_bytes()
