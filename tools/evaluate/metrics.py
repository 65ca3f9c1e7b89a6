"""What is measured of an episode: pure functions of its record, by name, and how their figures are read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from servoid.tools.evaluate.judge import ENDED

Record = Mapping[str, Any]


def fell_or_broken_off(record: Record) -> bool:
    """Whether an episode ended by a fall, by the guard, or before it began, and not as its task ends."""
    return bool(record.get("fell")) or record.get("outcome") not in ENDED


# None where an episode has no such figure.
MEASURES: dict[str, Callable[[Record], float | None]] = {
    "success": lambda record: record.get("success"),
    "fell_or_broken_off": fell_or_broken_off,
    "ticks": lambda record: record.get("ticks"),
    "floating_mm": lambda record: record.get("motion", {}).get("floating_mm"),
    "jerk_mps3": lambda record: record.get("motion", {}).get("jerk_mps3"),
    "foot_slip_mmps": lambda record: record.get("motion", {}).get("foot_slip_mmps"),
}


@dataclass(frozen=True)
class Metric:
    """A figure of each episode, whose mean is the row's value: one of MEASURES, or a metric of the task by its name."""

    of: str
    unit: str = ""
    share: bool = False  # true or false, instead of a number
    lower: bool = False  # whether less is better
    # How an episode counts that fell or was stopped: until then, with what it left undone, or (like all that did not
    # succeed) not at all.
    unfinished: Literal["until then", "whole", "left out"] = "until then"
    resolution: float = 0.0  # of the unit: what is finer is rounding of the simulation, and nothing to compare

    def values(self, records: Sequence[Record]) -> list[float]:
        """The figure of each episode that has it."""
        values = [self._measure(record) for record in records]
        finite = [float(value) for value in values if value is not None and math.isfinite(value)]
        return [round(value / self.resolution) * self.resolution for value in finite] if self.resolution else finite

    def unknown(self, records: Sequence[Record]) -> str:
        """The names that are measured of the episodes, where this metric's is none of them; else nothing."""
        names = {*MEASURES, *(name for record in records for name in record.get("metrics", {}))}
        return "" if self.of in names or len(names) == len(MEASURES) else ", ".join(sorted(names))

    def _measure(self, record: Record) -> float | None:
        return MEASURES[self.of](record) if self.of in MEASURES else record.get("metrics", {}).get(self.of)


METRICS: dict[str, Metric] = {
    "success": Metric("success", share=True),
    "falls": Metric("fell_or_broken_off", share=True, lower=True),  # a robot that cannot go on has not stayed up
    "ticks": Metric("ticks", "ticks", unfinished="whole"),
    "velocity_error": Metric("velocity_error_mps", "m/s", lower=True, unfinished="whole"),
    "seconds_to_goal": Metric("seconds_to_goal", "s", lower=True, unfinished="left out"),
    "floating": Metric("floating_mm", "mm", lower=True, resolution=0.001),
    "jerk": Metric("jerk_mps3", "m/s3", lower=True),
    "foot_slip": Metric("foot_slip_mmps", "mm/s", lower=True),
}
