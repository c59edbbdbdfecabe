"""Create broken and hostile files, and check that commands handle them correctly."""

from __future__ import annotations

import contextlib
import io
import json
import resource
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nerfbake.cli.main import run

LONGEST = 5.0  # CPU seconds that a command may take for a broken file, over all threads
STUCK = 60.0  # seconds of wall time, for commands that wait without computing; larger, because the CPU may be busy
LONGEST_LINE = 400  # characters of a message, including the file's path: one or two lines on a screen
MEMORY = 3 << 30  # bytes of address space
TIMERS = ((signal.SIGPROF, signal.ITIMER_PROF, LONGEST), (signal.SIGALRM, signal.ITIMER_REAL, STUCK))


def damaged(data: bytes, *, flips: int) -> Iterator[tuple[str, bytes]]:
    """Yield the file truncated at every 1 %, then with single bits flipped."""
    for percent in range(100):
        yield f"cut at {percent} %", data[: len(data) * percent // 100]
    random = np.random.default_rng(0)
    for _ in range(flips):
        bit = int(random.integers(8 * len(data)))
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        yield f"bit {bit} flipped", bytes(broken)


def complaint(arguments: list[str], output: Path | None) -> str | None:
    """Run a command and return what is wrong with how it handled its input; None if nothing is."""
    errors, printed, start = io.StringIO(), io.StringIO(), time.process_time()
    for sign, timer, most in TIMERS:
        signal.signal(sign, _too_long)
        signal.setitimer(timer, most)
    try:
        with (
            contextlib.redirect_stderr(errors),
            contextlib.redirect_stdout(printed),
            warnings.catch_warnings(record=True) as warned,
        ):
            # Warnings are not raised as errors: a SyntaxWarning would become a SyntaxError, which the code may catch.
            warnings.simplefilter("always")
            code = run(arguments)
    except BaseException as error:
        return f"{type(error).__name__}: {error} after {time.process_time() - start:.1f} s of CPU"
    finally:
        for _, timer, _ in TIMERS:
            signal.setitimer(timer, 0)
    if warned:
        return f"exit {code}, warned: {warned[0].category.__name__}: {warned[0].message} at {warned[0].filename}"
    lines = errors.getvalue().splitlines()
    told = printed.getvalue().splitlines()
    for line in lines + told if arguments[0] == "check" else lines:
        if len(line) > LONGEST_LINE or not line.isprintable():
            return f"exit {code}, said {len(line):,} characters: {line[:200]!r}"
    if arguments[0] == "check" and code == 1 and told and not lines:
        return None  # `check` prints the problems on stdout
    there = output is not None and output.exists()
    if there and output is not None:
        output.unlink()
    if code == 1 and not (len(lines) == 1 and lines[0].startswith("error: ") and not there):
        return f"exit 1, output there: {there}, said {lines}"
    if code not in (0, 1):
        return f"exit {code}, said {lines}"
    return None


def refused(tmp_path: Path, data: bytes, capfd: pytest.CaptureFixture[str], name: str = "bad.npz") -> str:
    """Return the one-line error of `svo` or `convert` for a file. `check` must report problems, too."""
    bad, out = tmp_path / name, tmp_path / "out.svo.pb"
    bad.write_bytes(data)
    assert complaint(["info", str(bad)], None) is None
    assert run(["check", str(bad)]) == 1
    assert name in capfd.readouterr().out
    assert run(["svo" if name.endswith("bad.npz") else "convert", str(bad), str(out)]) == 1
    said = capfd.readouterr()
    assert said.out == ""
    assert not list(tmp_path.glob("*out*"))
    (line,) = said.err.splitlines()
    assert line.startswith(f"error: {bad}: ")
    assert "allowed" in line
    assert line.isprintable()
    return line


def refused_as_it_is(bad: Path, data: bytes, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one-line error of `info` for a file. `check` must report problems, too."""
    bad.write_bytes(data)
    assert run(["info", str(bad)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {bad}: ")
    assert "allowed" in line
    assert run(["check", str(bad)]) == 1
    return line


def _too_long(*_: object) -> None:
    raise TimeoutError


def findings(command: str, source: Path, flips: int) -> list[str]:
    """Run a command on every damaged copy of a file, and return what is wrong."""
    data = source.read_bytes()
    suffix = source.name.partition(".")[2]
    bad, out = source.with_name(f"bad.{suffix}"), source.with_name("out.svo.npz")
    assert run([command, str(source), str(out), "-q"]) == 0  # imports and compiles, so that this time is not measured
    out.unlink()
    found = []
    for name, broken in damaged(data, flips=flips):
        bad.write_bytes(broken)
        if said := complaint([command, str(bad), str(out), "-q"], out):
            found.append(f"{name}: {said}")
    return found


def main(flips: int, jobs: list[str]) -> None:
    """Print a line of JSON for each command and file, with limited memory."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    for command, source in zip(jobs[::2], jobs[1::2], strict=True):
        print(json.dumps(findings(command, Path(source), flips)), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
