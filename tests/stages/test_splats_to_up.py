"""Splats that look upside down: how often that is right, silent and wrong."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Splats, load
from nerfbake.scene.splats import UPS
from nerfbake.stages.splats_to_up import Stand, measure_stand
from tests.support.standing import STANDING, standing

NARROW = {"a bowl", "a bar table", "a thing below a ceiling"}  # the known faults


def says(splats: Splats) -> str:
    """What it says about splats that are upright: wrong or silent; and of the same upside down: right or silent."""
    if measure_stand(splats).upside_down:
        return "wrong"
    return "right" if measure_stand(splats.flipped()).upside_down else "silent"


def test_what_the_documentation_says() -> None:
    """Straight, and tilted by 5 degrees: docs/splats.md has these counts."""
    found = {tilt: Counter(says(standing(name, tilt=tilt)) for name in STANDING) for tilt in EXPECTED}
    assert {
        tilt: tuple(count[key] for key in ("right", "silent", "wrong")) for tilt, count in found.items()
    } == EXPECTED
    wrong = {name for name in STANDING if says(standing(name)) == "wrong"}
    assert wrong == NARROW


EXPECTED = {0: (6, 15, 3), 5: (2, 22, 0)}  # by the tilt in degrees


@pytest.mark.parametrize("up", [up for up in UPS if up not in ("y", "-y")])
def test_splats_that_lie_on_their_side_are_not_called_upside_down(up: str) -> None:
    for name in STANDING:
        lying = standing(name).with_up(up)  # type: ignore[arg-type]
        assert not measure_stand(lying).upside_down


@pytest.mark.data
def test_a_real_capture_is_told_both_ways(data: Path) -> None:
    splats = load(data / "splats/biker.spz", Splats)
    assert not measure_stand(splats).upside_down
    turned = measure_stand(splats.flipped())
    assert turned.upside_down
    assert turned.ratio == pytest.approx(0.22, abs=0.01)


def test_little_and_nothing_are_silent() -> None:
    splats = standing("a turntable")
    few = Splats(*(getattr(splats, name)[:400] for name in ("means", "scales", "quats", "opacity", "sh")))
    assert measure_stand(few) == Stand(1.0, 0.0)
    flat = Splats(
        splats.means * np.array([1, 0, 1], np.float32), splats.scales, splats.quats, splats.opacity, splats.sh
    )
    assert measure_stand(flat) == Stand(1.0, 0.0)
