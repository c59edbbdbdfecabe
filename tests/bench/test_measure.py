from __future__ import annotations

import time
from typing import Any

import pytest

from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics, Work, measure, seconds_of
from nerfbake.errors import InvalidScene


def sleeping(seconds: float) -> Work:
    return Work(lambda: time.sleep(seconds), lambda _: {"slept": seconds})


def filling(earlier: int, megabytes: int) -> Work:
    bytearray(b"x") * (earlier << 20)  # what ran before must not count

    def run() -> bytes:
        return b"x" * (megabytes << 20)

    return Work(run, lambda result: {"size": len(result)})


def without_a_library() -> Work:
    import no_such_library  # type: ignore[import-not-found]

    return Work(no_such_library.run, dict)


def refusing() -> Work:
    raise InvalidScene("this cannot be")


def breaking() -> Work:
    raise ZeroDivisionError("by nothing")


def test_time_is_that_of_the_work_alone() -> None:
    result = measure(sleeping, seconds=0.05)
    assert 0.05 <= result.seconds < 0.5
    assert result.facts == {"slept": 0.05}


def test_the_peak_is_what_the_work_added() -> None:
    parent: Any = bytearray(64 << 20)  # the child must not inherit this as its own peak
    result = measure(filling, earlier=200, megabytes=40)
    assert 38 << 20 < result.peak < 60 << 20
    assert len(parent) == 64 << 20


@pytest.mark.parametrize(
    ("function", "error"),
    [
        (without_a_library, "not installed: no_such_library"),
        (refusing, "this cannot be"),
        (breaking, "ZeroDivisionError: by nothing"),
    ],
)
def test_what_goes_wrong_is_a_result(function: Any, error: str) -> None:
    assert measure(function).error == error


def test_statistics_are_median_and_ends() -> None:
    assert Statistics.of([3.0, 1.0, 10.0, 2.0]) == (2.5, 1.0, 10.0, 4)


def test_seconds_are_those_of_the_work_whose_result_they_stand_beside() -> None:
    def work() -> str:
        time.sleep(0.05)
        return "slept"

    found, seconds = seconds_of(work)
    assert found == "slept"
    assert 0.05 <= seconds < 0.5


def test_the_environment_says_what_is_not_installed() -> None:
    told = environment("numpy", "no-such-package")
    assert told["no-such-package"] == "-"
    assert told["numpy"].count(".") >= 1
    assert "cores" in told["machine"]
