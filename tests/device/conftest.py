"""One software device for all tests."""

from __future__ import annotations

import pytest

from nerfbake.device.gpu import Gpu
from tests.support.device import opened


@pytest.fixture(scope="session")
def gpu() -> Gpu:
    return opened()
