"""One browser for all tests of pages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from nerfbake import build_field, sample_n3tree
from tests.support.browser import Browser, chromium
from tests.support.viewed import Made, exact_page


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="session")
def exact(folder: Path) -> Made:
    return exact_page(folder / "exact.html", build_field(sample_n3tree(resolution=32)), "A sample")
