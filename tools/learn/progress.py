"""What a training shows while it runs: one line, rewritten, with the time that is left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import TracebackType
from typing import Any


class ProgressLine:
    """The share of a budget that is used, the time left by the pace of this call, and what was measured last."""

    def __init__(self, share: float) -> None:
        """`share` of the budget was used before, 0 to 1."""
        from tqdm import tqdm

        self._first = share
        self._seconds = 0.0
        self._bar: Any = tqdm(
            total=100,
            initial=round(100 * share),
            bar_format="{percentage:3.0f}%|{bar:10}| {desc}",
            file=sys.stderr,
            mininterval=0.0,
            dynamic_ncols=True,
        )

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()

    def trained(self, share: float, seconds: float, text: str) -> None:
        """`seconds` more of training brought the run to `share`."""
        self._seconds += seconds
        gained = share - self._first
        left = f"{duration(self._seconds * (1.0 - share) / gained)} left, " if gained > 0.0 and share < 1.0 else ""
        self._bar.n = round(100 * share)
        self._bar.set_description_str(left + text)

    def note(self, text: str) -> None:
        """Say what is being done now."""
        self._bar.set_description_str(text)

    def write(self, text: str) -> None:
        """A line that stays."""
        self._bar.write(text, file=sys.stderr)


def counted(count: int, what: str) -> Iterator[int]:
    """`range(count)` with a line of its own that says how far `what` is; nothing where nobody looks at a terminal."""
    from tqdm import trange

    yield from trange(count, desc=what, unit="tick", leave=False, file=sys.stderr, disable=None, dynamic_ncols=True)


def duration(seconds: float) -> str:
    """A time that a person plans with."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
