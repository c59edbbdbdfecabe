"""One browser for all tests of pages, and one runner of each language for all shader twins."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from nerfbake import build_field, sample_n3tree
from tests.support.browser import Browser, chromium
from tests.support.shaders import LANGUAGES, Runner, runner_of
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


@pytest.fixture(scope="session", params=LANGUAGES)
def runner(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return runner_of(request.param, tmp_path_factory.mktemp(request.param))
