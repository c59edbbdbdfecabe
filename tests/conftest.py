"""Shared fixtures, and a check that tests of real data are not skipped if the data are available."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

from tests.support.compression import with_fewer_rays
from tests.support.forks import Forks
from tests.support.kernels import kernels_that_ran

REPOSITORY = Path(__file__).parents[1]
DATA = Path(os.environ.get("NERFBAKE_DATA", REPOSITORY.parent / "shared" / "data"))

EXAMPLES = int(os.environ.get("NERFBAKE_EXAMPLES", "15"))  # per Hypothesis test; test-cpus takes 25
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=EXAMPLES)
hypothesis.settings.load_profile("repeatable")

# Processes that tests start keep the modules that they compile, even if the environment disables that. pip has compiled
# those of the packages: with a cache of their own, the tests would compile them once more.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# If the tests run in the background (nohup, &), they and their child processes inherit that SIGINT is ignored.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

TOOLS = ("nanovdb_convert", "nanovdb_print", "nanovdb_validate", "vdb_print")
# Fixtures that need programs from `make tools`: a browser, a graphics driver, torch, compilers.
TOOL_FIXTURES = {"browser", "firefox", "fp16_reader", "generated", "hlsl", "lines", "programs"}
TOOL_FIXTURES |= {"reader", "runner", "torch"}

Shell = Callable[..., subprocess.CompletedProcess[bytes]]


@pytest.fixture(scope="session")
def data() -> Path:
    return DATA


@pytest.fixture(scope="session")
def chair(data: Path) -> Path:
    return data / "plenoctree" / "chair"


@pytest.fixture(scope="session")
def torch() -> str:
    """The path of a Python with torch: Debian's, with its package python3-torch."""
    python = "/usr/bin/python3"
    if not Path(python).exists() or subprocess.run([python, "-c", "import torch"], capture_output=True).returncode:
        pytest.skip("no torch here: Debian's python3-torch has it")
    return python


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    found = Forks(REPOSITORY)
    yield found
    found.close()


@pytest.fixture
def shell(tmp_path: Path, forks: Forks) -> Shell:
    """Run the real command line in a new folder: shell('svo', 'a.npz', 'b.svo.pb', stdin=b'...')."""

    def run(*arguments: str, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
        return forks.run(arguments, tmp_path, stdin)

    return run


@pytest.fixture
def fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    with_fewer_rays(monkeypatch)


RUN_AT_IMPORT = pytest.StashKey[list[str]]()  # the kernels that ran while tests were collected


def pytest_configure(config: pytest.Config) -> None:
    config.option.loadscopereorder = False  # xdist would begin with the files of the most tests, however short they are
    gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Take modules and tests out of garbage collection: they stay, and every full collection would visit them."""
    session.config.stash[RUN_AT_IMPORT] = kernels_that_ran()
    gc.collect()
    gc.freeze()
    gc.enable()


# Seconds: an estimate for each test, by its first marker here, and the files of tests that take much longer.
SECONDS = {"long": 5.0, "slow": 1.5, "tools": 0.5}
LONGER = {"tests/test_readme.py": 5.0, "tests/fuzz/test_fuzz.py": 30.0}


def seconds_of(item: pytest.Item) -> float:
    own = next((seconds for name, seconds in SECONDS.items() if item.get_closest_marker(name)), 0.05)
    return own + (LONGER.get(str(item.path.relative_to(REPOSITORY)), 0.0) if own == SECONDS["long"] else 0.0)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Mark the tests, let pytest select by marker, and begin with the files that take longest.

    `--dist loadfile` gives each file to one worker: a file of a minute at the end would run alone.
    """
    mark(items)
    yield
    if "PYTEST_XDIST_WORKER" in os.environ:
        files: dict[Path, float] = {}
        for item in items:
            files[item.path] = files.get(item.path, 0.0) + seconds_of(item)
        items.sort(key=lambda item: -files[item.path])


def mark(items: list[pytest.Item]) -> None:
    for item in items:
        if isinstance(item, pytest.Function) and TOOL_FIXTURES & {*item.fixturenames}:
            item.add_marker("tools")
    if missing := [name for name in TOOLS if shutil.which(name) is None]:
        for item in items:
            if item.get_closest_marker("tools"):
                item.add_marker(pytest.mark.skip(reason=f"no {', '.join(missing)}: `make tools` installs them"))
    if not DATA.is_dir():
        for item in items:
            if item.get_closest_marker("data"):
                item.add_marker(pytest.mark.skip(reason=f"no real scenes in {DATA}"))


_must_not_be_skipped: list[str] = []


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.skipped and ("CI" in os.environ or ("data" in report.keywords and DATA.is_dir())):
        _must_not_be_skipped.append(report.nodeid)


def pytest_sessionfinish(session: pytest.Session) -> None:
    if _must_not_be_skipped:
        print("\nskipped, although all that they need must be there:", *_must_not_be_skipped, sep="\n  ")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
