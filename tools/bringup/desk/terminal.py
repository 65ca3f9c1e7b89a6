"""The terminal that a verb of bring-up was started in: it prints, asks, and reads keys."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, Observation
from servoid.tools.common.output import Report
from servoid.tools.common.prompt import confirm

if TYPE_CHECKING:
    from servoid.stack.log.tick import Listener
    from servoid.stack.runtime.operator import Operator
    from servoid.tools.bringup.desk.jogging import Source


class Desk:
    """What a verb asks of its person. `operator` may stop it from elsewhere; `listeners` hear each tick of a loop."""

    operator: Operator | None = None
    listeners: tuple[Listener, ...] = ()

    def __init__(self, report: Report) -> None:
        self.report = report

    def confirm(self, text: str, remedy: str = "give --yes to continue without being asked") -> None:
        """Return when the person agrees. Raises Cancelled where they do not, ConfigError where nobody is there."""
        confirm(text, remedy)

    def progress(self, text: str) -> None:
        """A line while something takes long. Raises Cancelled where the person wants it to end."""
        self.report.line(text)

    def check_keys(self) -> None:
        """Raise ConfigError where nothing could be jogged by."""
        if not sys.stdin.isatty():
            raise ConfigError("keys need a terminal: without one, use --by RAD")

    def keys(self) -> AbstractContextManager[Source]:
        """What a joint is jogged by, while it is entered."""
        from servoid.tools.bringup.desk.jogging import Keys

        return Keys()

    def show_limp(self, joints: Array, reference: Array | None = None) -> None:
        """Where the joints `(n_joints,)` rad of a limp robot are now, and should be."""

    def show_read(self, observation: Observation) -> None:
        """What was read of a robot that is watched."""

    def redraws(self, show: Callable[[Report, bool], None]) -> Callable[[], None] | None:
        """What shows a table over and over, by `show(report, redraw)`; None where nobody looks."""
        live = sys.stdout.isatty() and not self.report.as_json
        return (lambda: show(self.report, True)) if live else None
