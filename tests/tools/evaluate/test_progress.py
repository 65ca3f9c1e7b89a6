"""The time that is left is told from what each experiment's episodes took."""

from __future__ import annotations

import pytest

from servoid.tools.evaluate.progress import Forecast, duration


def test_long_episodes_that_are_still_to_come_count_as_long() -> None:
    """Of ten short ones and ten that may last ten times as long, half are not half the time."""
    forecast = Forecast([6.0, 60.0], [10, 10])
    assert forecast.seconds(1) is None
    for _ in range(10):
        forecast.done(0, 2.0)
    assert forecast.seconds(1) == pytest.approx(200.0)
    assert forecast.seconds(2) == pytest.approx(100.0)
    forecast.done(1, 5.0)  # it ended early: the others are taken to do so too
    assert forecast.seconds(1) == pytest.approx(45.0)


def test_episodes_of_an_experiment_that_refuses_are_not_waited_for() -> None:
    forecast = Forecast([6.0, 60.0], [2, 100])
    forecast.done(0, 2.0)
    forecast.drop(1)
    assert (forecast.left, forecast.seconds(1)) == (1, pytest.approx(2.0))
    forecast.done(1, 1.0)  # one that another process had begun
    assert forecast.left == 1


def test_times_are_told_as_a_person_would() -> None:
    assert [duration(x) for x in (12.3, 89.0, 600.0, 9000.0)] == ["12 s", "89 s", "10 min", "2.5 h"]
