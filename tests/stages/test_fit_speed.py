"""The speed of a device, which decides how long its schedules are."""

from __future__ import annotations

import pytest

from nerfbake.stages.fit_speed import measure_speed
from tests.support.device import opened


@pytest.mark.long
def test_a_software_adapter_is_slower_than_two_cores() -> None:
    gpu = opened()
    assert 0 < measure_speed(gpu) < 2
    gpu.close()
