"""What film and plot both draw of a flight log, in the odometry frame: the robot's path, its goal and plans, and what
the episode held."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import SceneObject
from servoid.hw.geometry import headed, joined, turned, yaw_of
from servoid.policy.features import raw_layout
from servoid.stack.log.flightlog import FlightLog
from servoid.stack.log.format import unpack
from servoid.stack.safety.phase import Phase


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


def objects(log: FlightLog) -> tuple[list[SceneObject], Array] | None:
    """The scene's objects, and where each was seen at each tick of the task `(ticks, n, 7)`, odometry frame."""
    poses = _seen(log, "objects")
    held = (log.header.get("scene") or {}).get("objects") or []
    made = [SceneObject(**{**each, "place": tuple(each["place"]), "size": tuple(each["size"])}) for each in held]
    return None if poses is None else (made, poses)


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


def goals(log: FlightLog) -> Array | None:
    """Where the robot saw the goal at each tick of the task `(ticks, 2)` m, odometry frame; None: not at each."""
    return _seen(log, "place")


def reach(log: FlightLog) -> float | None:
    """Distance from the goal that counts as there [m]; None where the task does not judge it, or the log is older."""
    return episode(log).get("reach")


def path(log: FlightLog) -> Array | None:
    """The way that the robot was asked to go `(n, 2)` m, odometry frame as it was when the task began."""
    points = episode(log).get("path")
    return None if points is None else np.array(points, dtype=float)


def drift(log: FlightLog, row: int) -> Array:
    """How far the robot saw the goal beside where its odometry had it `(2,)` m, at a tick of the task by its number."""
    seen, first = goals(log), episode(log).get("goal")
    return np.zeros(2) if seen is None or first is None else seen[row] - first


def pushes(log: FlightLog) -> dict[int, Array]:
    """Changes of the base's velocity `(2,)` m/s that the run came to, by ticks of the run."""
    ticks, planned = task_ticks(log), episode(log).get("pushes") or {}
    return {int(ticks[int(at)]): np.array(push) for at, push in planned.items() if int(at) < len(ticks)}


@dataclass(frozen=True)
class Pose:
    tick: int  # of the run, at which to be there
    place: Array  # (3,) m of the base, odometry frame
    orientation: Array  # (4,) quaternion w x y z
    joints: Array  # (n_joints,) rad


def keyframes(log: FlightLog) -> list[Pose]:
    """Poses that the robot was asked to be in, in their order."""
    ticks, held = task_ticks(log), episode(log)
    if "frames" not in held or not len(ticks):
        return []
    rows = np.array(held["frames"], dtype=float)
    layout = raw_layout(len(log.header["robot"]["joints"]))
    part = {name: rows[:, layout.slice(name)] for name in ("displacement", "yaw", "gravity", "position")}
    down = part["gravity"]
    tilted = joined(1.0 - down[:, 2], -down[:, 1], down[:, 0], np.zeros(len(rows)))  # brings gravity below the base
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    turned_to = headed(tilted, part["yaw"][:, 0] - yaw_of(tilted))
    places = zip(held["ticks"], part["displacement"], turned_to, part["position"], strict=True)
    return [Pose(int(ticks[0]) + int(tick), *pose) for tick, *pose in places]


def episode(log: FlightLog) -> dict[str, Any]:
    """What the episode held, as data; empty for a log from before it was recorded."""
    held: dict[str, Any] = log.header.get("episode") or {}
    return held


def _seen(log: FlightLog, what: str) -> Array | None:
    """What of a kind was perceived at each tick of the task; None where it was not at each."""
    seen = [message[what] for message in log.messages["/instruction"] if what in message]
    return np.array([unpack(value) for value in seen]) if seen and len(seen) == len(task_ticks(log)) else None
