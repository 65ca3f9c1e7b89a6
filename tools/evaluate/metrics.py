"""What is measured of an episode: pure functions of its record, by name, and how their figures are read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from servoid.tools.evaluate.judge import ENDED

Record = Mapping[str, Any]
IN_TIME = 5.0  # s to get up in


def fell_or_broken_off(record: Record) -> bool:
    """Whether an episode ended by a fall, by the guard, or before it began, and not as its task ends."""
    return bool(record.get("fell")) or record.get("outcome") not in ENDED


def rose(record: Record) -> float | None:
    """How long it took from its first motion to standing [s], after the first fall of an episode that it got up from;
    where it began lying, that is the first."""
    seconds = record.get("stand_seconds") or []
    return float(seconds[0]) if seconds else None


def rose_in_time(record: Record) -> bool:
    """Whether it stood within `IN_TIME` of its first motion, and at the end."""
    seconds = rose(record)
    return seconds is not None and seconds <= IN_TIME and not record.get("fell")


# None where an episode has no such figure.
MEASURES: dict[str, Callable[[Record], float | None]] = {
    "success": lambda record: record.get("success"),
    "fell_or_broken_off": fell_or_broken_off,
    "on_its_feet": lambda record: not fell_or_broken_off(record),
    "fell_ending": lambda record: record.get("fell_ending"),
    "ever_fell": lambda record: fell_or_broken_off(record) or bool(record.get("falls")),
    "rose_in_time": rose_in_time,
    "seconds_to_rise": rose,
    "ticks": lambda record: record.get("ticks"),
    "prior_error": lambda record: record.get("manner", {}).get("prior_error"),
    "amplitude": lambda record: record.get("manner", {}).get("amplitude"),
    "cadence": lambda record: record.get("manner", {}).get("cadence"),
    "style": lambda record: record.get("manner", {}).get("style"),
    "floating_mm": lambda record: record.get("motion", {}).get("floating_mm"),
    "jerk_mps3": lambda record: record.get("motion", {}).get("jerk_mps3"),
    "foot_slip_mmps": lambda record: record.get("motion", {}).get("foot_slip_mmps"),
}


@dataclass(frozen=True)
class Metric:
    """A figure of each episode, whose mean (or `median`) is the row's value: one of MEASURES, or the task's metric of
    that name."""

    of: str
    unit: str = ""
    share: bool = False  # true or false, instead of a number
    lower: bool = False  # whether less is better
    median: bool = False
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
    "falls_ending": Metric("fell_ending", share=True, lower=True),  # after the task, as it was lowered or went limp
    "ever_fell": Metric("ever_fell", share=True, lower=True),  # and got up again, perhaps
    "on_its_feet": Metric("on_its_feet", share=True),
    "rose_in_time": Metric("rose_in_time", share=True),
    "seconds_to_rise": Metric("seconds_to_rise", "s", lower=True, median=True, unfinished="left out"),
    "ball_speed": Metric("ball_speed_mps", "m/s"),
    "steady_speed": Metric("steady_speed_mps", "m/s"),
    "turning_rate": Metric("turning_rate_radps", "rad/s"),
    "joint_error": Metric("joint_rms_rad", "rad", lower=True),
    "understood": Metric("understood", share=True),
    "return": Metric("return", unfinished="whole"),
    "prior_error": Metric("prior_error", "of the data's", lower=True),
    "amplitude": Metric("amplitude", "of the data's"),
    "cadence": Metric("cadence", "of the data's"),
    "style": Metric("style", "of its windows"),
    "hit": Metric("hit", share=True, lower=True),
    "clip_error": Metric("clip_error_m", "m", lower=True),
    "ticks": Metric("ticks", "ticks", unfinished="whole"),
    "velocity_error": Metric("velocity_error_mps", "m/s", lower=True, unfinished="whole"),
    "seconds_to_goal": Metric("seconds_to_goal", "s", lower=True, unfinished="left out"),
    "floating": Metric("floating_mm", "mm", lower=True, resolution=0.001),
    "jerk": Metric("jerk_mps3", "m/s3", lower=True),
    "foot_slip": Metric("foot_slip_mmps", "mm/s", lower=True),
}
