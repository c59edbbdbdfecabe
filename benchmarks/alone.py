"""Run a command of nerfbake, and write how many CPU seconds one thread worked while no other thread could help.

    python -m benchmarks.alone facts.json fit photographs scene.npz

In this process, these are the seconds of the main thread outside of work that it shares with others: more cores do not
shorten them, and other work on the machine does not change them. A process that the command starts is watched from
outside: they are the seconds of intervals in which one of its threads did nearly all the work.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

from nerfbake.kernels import parallel
from nerfbake.kernels.compile_times import compiling

_INTERVAL = 0.2  # seconds between two looks at the threads of other processes
_NEARLY_ALL = 0.9


class SharedWork:
    """The CPU seconds of the main thread in work that it shares with other threads, without compiling kernels."""

    def __init__(self) -> None:
        self.seconds, self.inside = 0.0, False

    def timed(self, function: Callable[..., None]) -> Callable[..., None]:
        """Return the function, which does shared work, with its seconds added."""

        @wraps(function)
        def run(*arguments: Any) -> None:
            if self.inside or threading.current_thread() is not threading.main_thread():
                return function(*arguments)
            self.inside, before = True, _worked()
            try:
                return function(*arguments)
            finally:
                self.inside = False
                self.seconds += _worked() - before

        return run


def _worked() -> float:
    return time.thread_time() - compiling().worked


def followed() -> SharedWork:
    """Time the shared work of this process. Modules import run_in_turn() by name, so call this before they do."""
    shared, shared_class = SharedWork(), parallel._Shared
    shared_class.run = shared.timed(shared_class.run)  # type: ignore[method-assign]
    parallel.run_in_turn = shared.timed(parallel.run_in_turn)
    return shared


class Watch:
    """Looks at the threads of the processes that this one starts, in a thread of its own. Linux only."""

    def __init__(self) -> None:
        self.alone, self._seen, self._ended = 0.0, _thread_seconds(), threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def _follow(self) -> None:
        while not self._ended.wait(_INTERVAL):
            now = _thread_seconds()
            moved = [seconds - self._seen.get(thread, 0.0) for thread, seconds in now.items()]
            if moved and max(moved) > _NEARLY_ALL * sum(moved):
                self.alone += max(moved)
            self._seen = now


def _thread_seconds() -> dict[str, float]:
    """Return the CPU seconds of each thread of each process that this process has started."""
    found = {}
    for process in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        for child in _words(process):
            for task in Path(f"/proc/{child}/task").glob("*/schedstat"):
                if spent := _words(task):
                    found[str(task)] = int(spent[0]) / 1e9
    return found


def _words(file: Path) -> list[str]:
    """Return the words of a file of a thread; none if the thread has ended."""
    try:
        return file.read_text().split()
    except OSError:
        return []


def main(words: Sequence[str]) -> None:
    """Run the command, and write the facts as JSON."""
    shared, watch = followed(), Watch()
    target, *command = words
    sys.argv = ["nerfbake", *command]
    from nerfbake.__main__ import main as run

    try:
        run()
    finally:
        watch.end()
        facts = {"alone": _worked() - shared.seconds + watch.alone, "compiled": compiling().worked}
        Path(target).write_text(json.dumps(facts))


if __name__ == "__main__":
    main(sys.argv[1:])
