"""What the page shows of a tick beside the robot in 3D: numbers as JSON, with what is near the robot's own limits."""

from __future__ import annotations

import json
import math
from collections import deque
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.faults import ROBOT, describe
from servoid.hw.geometry import yaw_of
from servoid.hw.robot.description import Robot
from servoid.stack.safety.event import Event
from servoid.stack.safety.health import FULL
from servoid.stack.safety.phase import ENDED, Phase
from servoid.tools.web.line.snapshot import RunInfo, Snapshot

FINE, NEAR, OVER = 0, 1, 2  # nothing, yellow, red
COLUMNS = ("position", "target", "effort", "temperature", "voltage", "age", "gain")
UNITS = ("rad", "rad", "N m", "°C", "V", "ms", "")
NEARLY = 0.7  # of a limit that has no earlier one of its own
HISTORY = 20.0  # s that are plotted
WINDOW = 250  # ticks of the timing's figures
KEPT_EVENTS = 300
QUIET = {"phase", "task", "derated", "plan", "system"}  # kinds of events that are not why a robot stops
ENDING = {Phase.STOPPING, Phase.LOWERING, *ENDED}
_DIGITS = 4


def levels(robot: Robot, snapshot: Snapshot, full: Array) -> Array:
    """How near joints are to what guard or servo allow: `(n_joints, columns)` of FINE, NEAR and OVER.

    `full` `(n_joints,)` rad is the position error at which a servo gives all it has, at gain 1.
    """
    limits, servos = robot.limits, robot.servos
    found = np.zeros((len(robot.names), len(COLUMNS)), int)
    column = {name: found[:, i] for i, name in enumerate(COLUMNS)}
    position, target = snapshot.position, snapshot.target
    inside = np.minimum(position - robot.lower, robot.upper - position)
    _mark(column["position"], inside < limits.margin, inside < 0.0)
    error = np.abs(target - position) * np.maximum(snapshot.gain, 1e-6) / full
    _mark(column["target"], error > NEARLY * FULL, error > FULL)
    effort = np.abs(snapshot.effort) / np.array([servo.stall_torque for servo in servos])
    _mark(column["effort"], effort > NEARLY * FULL, effort > FULL)
    warm = limits.temperature - 10.0 if limits.derate_temperature is None else limits.derate_temperature
    _mark(column["temperature"], snapshot.temperature > warm, snapshot.temperature > limits.temperature)
    low, high = np.array([servo.voltage_range for servo in servos]).T
    empty = low if limits.voltage is None else np.maximum(low, limits.voltage)
    weak = empty if limits.derate_voltage is None else np.maximum(low, limits.derate_voltage)
    out = (snapshot.voltage < empty) | (snapshot.voltage > high)
    _mark(column["voltage"], (snapshot.voltage < weak) | out, out)
    _mark(column["age"], snapshot.age > 1.5 * robot.dt, snapshot.age > limits.stale * robot.dt)
    _mark(column["gain"], snapshot.gain < 1.0 - 1e-6, snapshot.gain < 0.5)
    return found


def _mark(column: Array, near: Array, over: Array) -> None:
    column[near] = NEAR
    column[over] = OVER


class Telemetry:
    """Frames of a run, as they come, and what somebody who opens the page now has missed."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        servos = robot.servos
        self._full = np.array([servo.stall_torque / servo.stiffness for servo in servos])
        self.events: list[tuple[int, str]] = []  # number and frame of each
        self._numbered = 0
        self.begin(None)

    def begin(self, info: RunInfo | None) -> None:
        """Another run: what was counted and kept is of the one before."""
        self.info = info
        self._frames: deque[tuple[float, str]] = deque()
        self._late: deque[float] = deque(maxlen=WINDOW)
        self._busy: deque[float] = deque(maxlen=WINDOW)
        self._missed = self._plans = self._unread = 0
        self.why, self._newest = "", ""
        self.outcome: tuple[str, str] | None = None

    def hello(self) -> str:
        """What a page needs to begin with."""
        robot, info = self.robot, self.info
        frame = {
            "kind": "hello",
            "robot": robot.name,
            "joints": list(robot.names),
            "columns": list(COLUMNS),
            "units": list(UNITS),
            "feet": list(robot.feet),
            "rate": robot.rate,
            "history": [json.loads(text) for _, text in self._frames],
            "run": None
            if info is None
            else {
                "title": info.title,
                "backend": info.backend,
                "policy": info.policy,
                "simulated": info.simulated,
                "goal": _numbers(info.goal),
                "reach": info.reach,
                "path": _numbers(info.path),
                "length": info.length,
                "steers": info.steers,
                "skills": info.skills,
            },
            "outcome": self.outcome,
        }
        return json.dumps(frame, allow_nan=False)

    def tick(self, snapshot: Snapshot) -> str:
        """The frame of a tick."""
        self._late.append(snapshot.late)
        self._busy.append(snapshot.busy)
        self._missed += snapshot.missed
        self._unread += int(np.isnan(snapshot.position).sum())
        for event in snapshot.events:
            self.hear(event)
        if snapshot.phase in ENDING and not self.why:
            self.why = self._newest
        text = json.dumps(self._frame(snapshot), allow_nan=False)
        self._frames.append((snapshot.time, text))
        while self._frames and snapshot.time - self._frames[0][0] > HISTORY:
            self._frames.popleft()
        return text

    def end(self, outcome: str, text: str) -> None:
        self.outcome = (outcome, text)

    def hear(self, event: Event) -> None:
        self._numbered += 1
        self._plans += event.kind == "plan"
        if event.kind not in QUIET:
            self._newest = event.text
        told = {"kind": "event", "time": round(event.time, 2), "what": event.kind, "joint": event.joint}
        self.events.append((self._numbered, json.dumps(told | {"text": event.text})))
        del self.events[:-KEPT_EVENTS]

    def _other(self, snapshot: Snapshot) -> dict[str, Any]:
        """What is plotted of another run."""
        pose = snapshot.pose
        return {
            "phase": snapshot.phase,
            "late": round(snapshot.late, 3),
            "busy": round(snapshot.busy, 3),
            "velocity": _numbers(snapshot.velocity),
            "place": None if pose is None else _numbers(np.array([*pose.place, yaw_of(pose.orientation)])),
            "values": _numbers(_values(snapshot)),
        }

    def _frame(self, snapshot: Snapshot) -> dict[str, Any]:
        pose = snapshot.pose
        supply = snapshot.voltage[np.isfinite(snapshot.voltage)]
        faults = {
            self.robot.names[i]: ", ".join(describe(int(snapshot.fault[i]) & ~ROBOT))
            for i in np.flatnonzero(snapshot.fault & ~ROBOT).tolist()
        }
        return {
            "kind": "tick",
            "tick": snapshot.tick,
            "time": round(snapshot.time, 3),
            "phase": snapshot.phase,
            "why": self.why,
            "late": round(snapshot.late, 3),
            "late_p99": round(float(np.percentile(self._late, 99)), 3),
            "busy": round(snapshot.busy, 3),
            "busy_p99": round(float(np.percentile(self._busy, 99)), 3),
            "missed": self._missed,
            "plans": self._plans,
            "unread": self._unread,
            "supply": round(float(np.median(supply)), 2) if len(supply) else None,
            "tilt": _number(math.degrees(snapshot.tilt)),
            "contact": _numbers(snapshot.contact),
            "velocity": _numbers(snapshot.velocity),
            "asked": _numbers(snapshot.asked),
            "text": snapshot.text,
            "place": None if pose is None else _numbers(np.array([*pose.place, yaw_of(pose.orientation)])),
            "goal": _numbers(snapshot.goal),
            "path": _numbers(snapshot.path),
            "obstacles": _numbers(snapshot.obstacles),
            "robots": _numbers(snapshot.robots),
            "plan": _numbers(snapshot.plan),
            "became": None if snapshot.became is None else _numbers(snapshot.became.places),
            "off": None if snapshot.became is None else [round(snapshot.became.off, 4), snapshot.became.ticks],
            "values": _numbers(_values(snapshot)),
            "other": None if snapshot.other is None else self._other(snapshot.other),
            "levels": levels(self.robot, snapshot, self._full).tolist(),
            "faults": faults,
        }


def _values(snapshot: Snapshot) -> Array:
    """COLUMNS of each joint `(n_joints, columns)`."""
    s = snapshot
    return np.stack([s.position, s.target, s.effort, s.temperature, s.voltage, s.age * 1e3, s.gain], axis=1)


def _number(value: float) -> float | None:
    return round(value, 2) if math.isfinite(value) else None


def _numbers(values: Array | None) -> Any:
    """Rounded numbers, however nested; what was not measured is null."""
    if values is None:
        return None
    rounded = np.round(np.asarray(values, dtype=float), _DIGITS)
    if np.isfinite(rounded).all():
        return rounded.tolist()
    return np.where(np.isfinite(rounded), rounded, None).tolist()  # type: ignore[call-overload]
