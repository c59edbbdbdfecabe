from __future__ import annotations

from benchmarks.aims import Aim, aims_table


def test_each_word_means_what_it_says() -> None:
    figures = (1.0, 2.0, 3.0)
    assert [Aim("at most", 2).holds(figure) for figure in figures] == [True, True, False]
    assert [Aim("below", 2).holds(figure) for figure in figures] == [True, False, False]
    assert [Aim("at least", 2).holds(figure) for figure in figures] == [False, True, True]


def test_what_was_not_measured_does_not_hold() -> None:
    table = aims_table([("speed", Aim("at most", 0.6), 0.5), ("size", Aim("below", 1.5), None)])
    assert table.rows == [["speed", "at most 0.6", 0.5, True], ["size", "below 1.5", None, False]]
