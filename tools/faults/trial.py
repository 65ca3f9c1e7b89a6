"""One trial of the fault campaign: a walk on the virtual rig in locked time, a fault in the middle of it, a verdict.

What the robot did is judged by the rig's own record of the goals that servos accepted; whether the fault was seen, by
the events of the run and by what it raised.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from servoid.hw.contracts.body import BackendError
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.rig.in_process import InProcessBackend
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.board import on_the_board
from servoid.sim.rig.wire.faults import EXPECTED, KINDS, NEEDS_SERVO, STATUS_KINDS, Outcome
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import LOWER_SECONDS, REST_SECONDS
from servoid.stack.safety.phase import Phase

DETECTION_TICKS = 10  # within which a fault that is not absorbed must be named
OFF_SECONDS = 0.5  # within which torque must be off then, where the bus reaches a servo
WATCHDOG_SECONDS = 0.1  # within which a servo that the bus does not reach must have stopped by itself
STATUS_PROBABILITY = 0.02  # of each status packet to be spoiled
_ABSORBED_SECONDS = 1.0  # that a fault which is to be absorbed lasts
_WALK_SECONDS = 0.8  # of walking before a fault at the earliest
_SPREAD_TICKS = 25  # over which the beginnings of faults are spread: half a cycle of the gait
_QUIET_KINDS = ("phase", "task", "system")  # of events that name nothing


@dataclass(frozen=True)
class Trial:
    """A fault and the seed of everything that is random about it: when, which servo, which packets."""

    kind: str
    seed: int
    robot: str = "op3"

    @property
    def number(self) -> list[int]:
        return [KINDS.index(self.kind), self.seed]


@dataclass
class Verdict:
    """How a trial ended. Ticks count from the fault, times [s] from its being named."""

    kind: str
    seed: int
    expected: str
    joint: str | None = None
    struck: int = 0
    unsafe_goals: int = 0
    named: bool = False
    detection_ticks: int | None = None
    ended: str = "running"  # or damped, hung, died
    fell: bool = False
    off_seconds: float | None = None
    problems: list[str] = field(default_factory=list)
    said: str = ""  # what named it


class Witnessed(InProcessBackend):
    """A virtual robot that is looked at once more, by the rig's own account, before it is let go.

    `powered` are the joints that are still driven then, and `later` those that are once the watchdog has had its time.
    """

    def __init__(self, rig: Rig, *, seed: int) -> None:
        super().__init__(rig, seed=seed)
        self.accepted: list[dict[str, Any]] = []
        self.powered: list[str] = []
        self.later: list[str] = []
        self._ended = False
        self.end_ns = 0

    @property
    def struck(self) -> int:
        """How often faults did strike."""
        return sum(self.rig.injector.struck.values())

    def close(self) -> None:
        if not self._ended:
            self._ended = True
            self.end_ns = self.clock.now_ns()
            self.powered = self.later = self._driven()
            if self.powered:
                self.clock.sleep_until(self.clock.now_ns() + round(WATCHDOG_SECONDS * 1e9))
                self.later = self._driven()
            self.accepted = self.rig.take_accepted()
        super().close()

    def _driven(self) -> list[str]:
        states = zip(self.rig.robot.names, self.rig.servo_states(), strict=True)
        return [name for name, servo in states if servo["torque"] and servo["online"] and not servo["tripped"]]


@cache
def _rig(robot: str) -> Rig:
    """A rig for one trial after the other."""
    return Rig(on_the_board(load_robot(robot)))


def fault_of(trial: Trial, robot: Robot) -> tuple[dict[str, Any], int, str | None]:
    """What to inject, at which tick of the walk, and the joint that it concerns if there is one."""
    rng = np.random.default_rng(trial.number)
    tick = round(_WALK_SECONDS * robot.rate) + int(rng.integers(_SPREAD_TICKS))
    joint = str(rng.choice(robot.names)) if trial.kind in NEEDS_SERVO else None
    fault: dict[str, Any] = {"kind": trial.kind}
    if joint is not None:
        fault["servo"] = joint
    if trial.kind in (*STATUS_KINDS, "garbage"):
        fault["probability"] = STATUS_PROBABILITY
    if EXPECTED[trial.kind] is not Outcome.FATAL:
        fault["until"] = _ABSORBED_SECONDS
    return fault, tick, joint


def run_trial(trial: Trial) -> Verdict:
    """Walk, inject, judge. Raises nothing that a run may raise: that is part of the verdict."""
    rig = _rig(trial.robot)
    robot = rig.robot
    fault, tick, joint = fault_of(trial, robot)
    verdict = Verdict(trial.kind, trial.seed, EXPECTED[trial.kind].value, joint)
    body = Witnessed(rig, seed=trial.seed)
    seconds = (tick + 5) * robot.dt + _ABSORBED_SECONDS
    settings = RunSettings(
        "walk",
        backend="virtual",
        robot=trial.robot,
        policy="gait",
        seconds=seconds,
        seed=trial.seed,
        set={"vx": "0.1", "vy": "0", "yaw_rate": "0"},
    )
    watch = _TrialWatch(body, fault, tick)
    error = ""
    outcome = ""
    try:
        result = run(settings, backend=body, on_tick=watch)
        outcome = result.outcome
    except BackendError as failure:
        error = str(failure)
    except Exception as failure:  # a bug, found by the campaign: reported with its seed
        verdict.problems.append(f"{type(failure).__name__}: {failure}")
    _judge(verdict, robot, body, watch, outcome, error)
    return verdict


class _TrialWatch:
    """Listens to a run, and injects the fault once."""

    def __init__(self, body: Witnessed, fault: dict[str, Any], tick: int) -> None:
        self._body, self._fault, self._at = body, fault, tick
        self.walked = 0
        self.ticks = 0  # since the fault
        self.began_ns: int | None = None  # when it was injected
        self.events: list[tuple[Event, int, int]] = []  # since the fault, with the ticks since it and the rig's time
        self.fell = False
        self.phases = {Phase.LIMP}

    def __call__(self, record: TickRecord) -> None:
        self.phases.add(record.phase)
        if self.began_ns is not None:
            self.ticks += 1
            self.events += [(event, self.ticks, self._body.clock.now_ns()) for event in record.events]
        if record.phase is not Phase.RUNNING:
            return
        self.fell |= bool(self._body.simulation.truth.fallen[0])
        self.walked += 1
        if self.walked == self._at:
            self.began_ns = self._body.clock.now_ns()
            self._body.inject(**self._fault)


def _judge(verdict: Verdict, robot: Robot, body: Witnessed, watch: _TrialWatch, outcome: str, error: str) -> None:
    if watch.began_ns is None:
        verdict.problems.append(f"the walk ended before the fault: {outcome} {error}".strip())
        return
    verdict.struck = body.struck
    unsafe = unsafe_goals(robot, body.accepted)
    verdict.unsafe_goals = len(unsafe)
    verdict.problems += unsafe[:3]
    verdict.fell = watch.fell
    verdict.ended = "running" if outcome in ("succeeded", "failed", "timed_out") else "damped"
    named_ns = _detection(verdict, body, watch, error)
    expected = Outcome(verdict.expected)
    in_order = Phase.LOWERING in watch.phases and Phase.FAULT not in watch.phases and not error
    if expected is not Outcome.ABSORBED and not (verdict.named and (verdict.detection_ticks or 0) <= DETECTION_TICKS):
        verdict.problems.append(f"not named within {DETECTION_TICKS} ticks" + (f", but: {error}" if error else ""))
    if not body.struck:
        verdict.problems.append("the fault never struck")
    if expected is Outcome.FATAL and verdict.ended == "running":
        verdict.problems.append("the run went on")
    if verdict.ended != "running" and not (expected is Outcome.FATAL or (expected is Outcome.NAMED and in_order)):
        verdict.problems.append(f"the run did not go on: {error or verdict.said or outcome}")
    if verdict.fell:
        verdict.problems.append("fell while walking")
    if body.later:
        verdict.problems.append(f"still driven at the end: {', '.join(body.later)}")
    if verdict.ended == "damped" and named_ns is not None:
        verdict.off_seconds = _off_seconds(body.accepted, named_ns)
        latest = OFF_SECONDS + (REST_SECONDS + LOWER_SECONDS if in_order else 0.0)
        if verdict.off_seconds is not None and verdict.off_seconds > latest:
            verdict.problems.append(f"torque off {verdict.off_seconds:.2f} s after it was named")


def _off_seconds(accepted: list[dict[str, Any]], named_ns: int) -> float | None:
    """How long after the naming the last servo switched torque off, or was stopped by its watchdog [s]."""
    first: dict[int, int] = {}
    for entry in accepted:
        stopped = (entry["register"], entry["value"]) in (("torque_enable", 0), ("bus_watchdog", 255))
        if stopped and entry["time_ns"] >= named_ns:
            first.setdefault(entry["joint"], entry["time_ns"])
    return None if not first else (max(first.values()) - named_ns) * 1e-9


def _detection(verdict: Verdict, body: Witnessed, watch: _TrialWatch, error: str) -> int | None:
    """Find what named the fault, and when by the rig's time [ns]. That of a servo must be named with its joint."""
    wanted = [] if verdict.joint is None else [verdict.joint]
    loud = [entry for entry in watch.events if entry[0].kind not in _QUIET_KINDS]
    said = [(f"{event.text} {event.joint or ''}", ticks, now) for event, ticks, now in loud]
    if error:
        said.append((error, watch.ticks + 1, body.end_ns))
    for text, ticks, now in said:
        if not wanted or any(joint in text for joint in wanted):
            verdict.named, verdict.detection_ticks, verdict.said = True, ticks, text.strip()
            return now
    return None


def unsafe_goals(robot: Robot, accepted: list[dict[str, Any]]) -> list[str]:
    """Goals that servos with torque took and that were outside a joint's range, or too far from the goal before for the
    time between them. Half a tick of the servo's count is allowed for rounding, at either end."""
    speed, period = robot.limits.joint_speed, robot.dt
    last: dict[int, tuple[int, float]] = {}
    powered: set[int] = set()
    wrong = []
    for entry in accepted:
        joint, register, time_ns, position = (entry[k] for k in ("joint", "register", "time_ns", "position"))
        name, tick = robot.names[joint], float(robot.tick_angles[joint])
        if register == "torque_enable":
            (powered.add if entry["value"] else powered.discard)(joint)
        if register != "goal_position":
            continue
        before = last.get(joint)
        last[joint] = (time_ns, position)
        if joint not in powered:
            continue
        if not robot.lower[joint] - tick / 2 <= position <= robot.upper[joint] + tick / 2:
            wrong.append(f"{name} took a goal of {position:.3f} rad at {time_ns * 1e-9:.3f} s, outside its range")
        if before is not None:
            periods = max(round((time_ns - before[0]) * 1e-9 / period), 1)
            if abs(position - before[1]) > speed * period * periods + tick:
                wrong.append(
                    f"{name} took a goal {abs(position - before[1]):.3f} rad from the one before, {periods} ticks "
                    f"later, at {time_ns * 1e-9:.3f} s"
                )
    return wrong
