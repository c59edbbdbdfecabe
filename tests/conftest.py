"""Fixtures that every test may use, and the rule that real data, where they are, are really tested."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

from tests.support.forks import Forks

REPOSITORY = Path(__file__).parents[1]
DATA = Path(os.environ.get("NERFBAKE_DATA", REPOSITORY.parent / "shared" / "data"))

EXAMPLES = int(os.environ.get("NERFBAKE_EXAMPLES", "25"))  # of each hypothesis; the long run takes 60
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=EXAMPLES)
hypothesis.settings.load_profile("repeatable")

# Processes that tests start find Python's modules compiled, also where the environment has none of them kept.
os.environ["PYTHONPYCACHEPREFIX"] = str(REPOSITORY / "build" / "modules")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Whoever starts the tests in the background (nohup, a shell's &) has them ignore Ctrl-C, and all that they start, too.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

TOOLS = ("nanovdb_convert", "nanovdb_print", "nanovdb_validate", "vdb_print")

Shell = Callable[..., subprocess.CompletedProcess[bytes]]


@pytest.fixture(scope="session")
def data() -> Path:
    return DATA


@pytest.fixture(scope="session")
def chair(data: Path) -> Path:
    return data / "plenoctree" / "chair"


@pytest.fixture(scope="session")
def torch() -> str:
    """A Python that has torch: Debian's, by its package python3-torch."""
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
    """Runs the real command line in a folder of its own: shell('svo', 'a.npz', 'b.svo.pb', stdin=b'...')."""

    def run(*arguments: str, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
        return forks.run(arguments, tmp_path, stdin)

    return run


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
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
