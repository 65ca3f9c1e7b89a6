"""What video and plot both draw: the robot's path, goal and plans of a flight log, in the odometry frame."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import turned
from servoid.stack.log.flightlog import FlightLog
from servoid.stack.log.format import unpack
from servoid.stack.safety.guard import Phase


@dataclass(frozen=True)
class DrawnPlan:
    adopted: int  # tick of the run
    path: Array  # (horizon, 2) m, odometry frame


def task_ticks(log: FlightLog) -> Array:
    """Ticks of the run in which the task ran; the first is the task's tick 0."""
    return log.ticks("/instruction")


def goal(log: FlightLog) -> Array | None:
    """The newest goal `(2,)` m, odometry frame."""
    places = [message["place"] for message in log.messages["/instruction"] if "place" in message]
    return unpack(places[-1]) if places else None


def obstacles(log: FlightLog) -> Array | None:
    """What was seen in the way at each tick of the task, `(ticks, n, 3)` m: x, y, radius, odometry frame."""
    return _seen(log, "obstacles")


def robots(log: FlightLog) -> Array | None:
    """Where the other robots were seen at each tick of the task, `(ticks, n, 3)`: x, y m, heading rad, odometry
    frame."""
    return _seen(log, "robots")


def got_up(log: FlightLog) -> list[int]:
    """Ticks at which the robot went on after a fall: the policy begins anew at the next."""
    phases = [(int(message["tick"]), message["phase"]) for message in log.messages["/command"]]
    return [tick for (_, before), (tick, now) in pairwise(phases) if (before, now) == (Phase.RECOVERING, Phase.RUNNING)]


def plans(log: FlightLog) -> list[DrawnPlan]:
    """Predicted paths of the task. Ticks of plans count calls of the policy, since it began: one a tick, and some after
    the task."""
    ticks, again = task_ticks(log), got_up(log)
    first = [0, *np.searchsorted(ticks, again, side="right").tolist()]  # of the task, each time that the policy began
    if not log.messages["/plan"]:
        return []
    at = {int(tick): row for row, tick in enumerate(log.ticks("/state"))}
    displacement, yaw = log.column("/state", "displacement"), log.column("/state", "yaw")
    found = []
    for message in log.messages["/plan"]:
        asked = first[bisect_right(again, message["tick"])] + message["requested"]
        if asked >= len(ticks):
            continue  # to come to rest
        row = at[int(ticks[asked])]
        path = displacement[row, :2] + turned(unpack(message["path"]), yaw[row])
        found.append(DrawnPlan(int(message["tick"]), path))
    return found


def _seen(log: FlightLog, what: str) -> Array | None:
    """What of a kind was perceived at each tick of the task; None where it was not at each."""
    seen = [message[what] for message in log.messages["/instruction"] if what in message]
    return np.array([unpack(value) for value in seen]) if seen and len(seen) == len(task_ticks(log)) else None
