"""Shares of a step, from loops inside loops."""

from __future__ import annotations

from nerfbake import progress


def heard() -> tuple[list[tuple[float, str]], progress.Listener]:
    shares: list[tuple[float, str]] = []
    return shares, lambda share, detail: shares.append((share, detail))


def test_each_reports_after_every_item() -> None:
    shares, listener = heard()
    with progress.listening(listener):
        assert list(progress.each("abcd")) == list("abcd")
    assert [share for share, _ in shares] == [0.25, 0.5, 0.75, 1]


def test_a_loop_in_a_loop_reports_its_part_of_an_item() -> None:
    shares, listener = heard()
    with progress.listening(listener):
        for _ in progress.each(range(2)):
            progress.report(0.5, "half")
    assert shares == [(0.25, "half"), (0.5, ""), (0.75, "half"), (1, "")]


def test_a_part_of_a_part() -> None:
    shares, listener = heard()
    with progress.listening(listener), progress.part(0.5, 1), progress.part(0, 0.5):
        progress.report(0.5)
    assert [share for share, _ in shares] == [0.625, 0.75, 1]


def test_nobody_listens_by_default_and_inside_of_nothing() -> None:
    progress.report(0.5)
    shares, listener = heard()
    with progress.listening(listener):
        with progress.listening(None), progress.part(0, 1):
            assert list(progress.each([1, 2])) == [1, 2]
        progress.report(2)
    assert shares == [(1, "")]


def test_a_loop_that_ends_early_leaves_the_listener_as_it_was() -> None:
    shares, listener = heard()
    with progress.listening(listener):
        for number in progress.each(range(4)):
            if number:
                break
        progress.report(0.9)
    assert shares[-1] == (0.9, "")
