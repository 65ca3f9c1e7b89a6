"""How long an evaluation still takes, and the bar that says so."""

from __future__ import annotations

import time
from collections.abc import Sequence


class Forecast:
    """Episodes of an experiment take as long as those before them; before there is any, as long as its task may last at
    the pace of the others. So long episodes that come last are not taken for short ones."""

    def __init__(self, limits: Sequence[float], episodes: Sequence[int]) -> None:
        """Of each experiment, what an episode lasts at most [s, simulated], and how many episodes are to be done."""
        self._limits, self._left = limits, list(episodes)
        self._done = [0] * len(limits)
        self._wall = [0.0] * len(limits)

    def done(self, experiment: int, wall_seconds: float) -> None:
        """An episode is done."""
        self._left[experiment] = max(self._left[experiment] - 1, 0)  # one that was begun before a `drop` counts no more
        self._done[experiment] += 1
        self._wall[experiment] += wall_seconds

    def drop(self, experiment: int) -> None:
        """No more episodes of an experiment will be done."""
        self._left[experiment] = 0

    @property
    def left(self) -> int:
        """Episodes that are to be done."""
        return sum(self._left)

    def seconds(self, workers: int) -> float | None:
        """Time left [s] on so many processes; None before anything is known."""
        simulated = sum(limit * done for limit, done in zip(self._limits, self._done, strict=True))
        if not simulated:
            return None
        pace = sum(self._wall) / simulated
        each = zip(self._left, self._done, self._wall, self._limits, strict=True)
        return sum(left * (wall / done if done else pace * limit) for left, done, wall, limit in each) / workers


class EpisodeBar:
    """A bar of episodes, with the time that is left by a forecast, or until the deadline [s, monotonic]."""

    def __init__(self, forecast: Forecast, workers: int, deadline: float | None) -> None:
        from tqdm import tqdm

        self._forecast, self._workers, self._deadline = forecast, workers, deadline
        form = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} episodes [{elapsed}{postfix}]"
        self._bar = tqdm(total=forecast.left, bar_format=form, mininterval=2.0, disable=not forecast.left)

    def done(self, experiment: int, wall_seconds: float) -> None:
        """An episode is done."""
        self._forecast.done(experiment, wall_seconds)
        self._update()

    def refused(self, experiment: int) -> None:
        """An episode could not be done, and no other of its experiment will be."""
        self._forecast.drop(experiment)
        self._update()

    def close(self) -> None:
        """Leave the bar as it stands."""
        self._bar.close()

    def _update(self) -> None:
        seconds = self._forecast.seconds(self._workers)
        if seconds is not None:
            if self._deadline is not None:
                seconds = min(seconds, max(self._deadline - time.monotonic(), 0.0))
            self._bar.set_postfix_str(f"about {duration(seconds)} left", refresh=False)
        self._bar.total = self._bar.n + 1 + self._forecast.left
        self._bar.update()


def duration(seconds: float) -> str:
    """A time as a person says it: 40 s, 12 min, 3.5 h."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
