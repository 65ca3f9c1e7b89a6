"""A recording on the gantry: motions through the guard, and their log."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.body import Array, Motors, Observation, Sensors
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import git_commit
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.estimation.sample_hold import missing
from servoid.stack.log.format import FORMAT
from servoid.stack.log.provenance import fingerprint, versions
from servoid.stack.log.recorder import Recorder
from servoid.stack.log.tick import Proposal
from servoid.stack.runtime.clock import Schedule
from servoid.stack.runtime.interrupt import Interrupt, Stops
from servoid.stack.runtime.loop import ControlledRobot, Loop
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.health import BLOCKED
from servoid.stack.safety.min_jerk import MIN_JERK_PEAK, MinJerk
from servoid.stack.safety.phase import Phase
from servoid.tools.identify.excitation import Exercise, middle_pose
from servoid.tools.identify.recording import END, PIECE

_WAIT_SECONDS = 1.0  # for a first sample of everything
_STILL_SECONDS = 1.0  # in the middle pose, before the first motion
_SHORT, _SHORT_SPEED, _SHORT_SECONDS = 0.15, 0.1, 0.4  # rad from its goal, rad/s, s: something is in a joint's way
_SLOW_READS = 0.5  # s of torque before anything moves, so that temperatures and the supply are known


@dataclass(frozen=True)
class GantryRun:
    """How a recording ended: `cause` is the guard's, "task" where it came to its end."""

    log: Path
    cause: str | None
    texts: tuple[str, ...]  # of what happened, in order


class Excitation:
    """Supervises a recording: torque on where each joint is, slowly to the middle pose, then motion after motion."""

    def __init__(self, robot: Robot, guard: Guard, motions: Sequence[Exercise]) -> None:
        self._robot, self._guard = robot, guard
        self._goals = np.concatenate([motion.goals for motion in motions])
        lengths = [len(motion.goals) for motion in motions]
        begins = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int).tolist()
        self._begins = dict(zip(begins, [motion.name for motion in motions], strict=True))
        self._held, self._first = 0, 0
        self._told = -1  # of the motions' ticks, the newest that was looked at
        self._way: MinJerk | None = None
        self._short = np.zeros(len(robot.names))  # s that each joint has been held short of its goal

    def act(self, tick: int, observation: Observation, state: State | None) -> Proposal:
        guard, dt = self._guard, self._robot.dt
        if guard.phase is Phase.LIMP:
            if state is not None:
                guard.hold(observation)
            elif tick * dt >= _WAIT_SECONDS:
                lacking = ", ".join(missing(observation, self._robot.names)) or "the IMU"
                guard.fault("stale", f"no sample from {lacking}: check cables and power")
        elif guard.phase is Phase.READY:
            self._held += 1
            if self._held * dt >= _SLOW_READS:
                guard.start()
        elif guard.phase is Phase.RUNNING and not self._stuck(observation):
            return Proposal(self._goal(tick))
        return Proposal()

    def _stuck(self, observation: Observation) -> bool:
        """End where a joint stands still away from its goal: it is at a stop that its file knows nothing of, or leans
        on something, and would teach the fit a stiffness that it has not."""
        away = np.abs(self._guard.applied - observation.position)
        held = (away > _SHORT) & (np.abs(observation.velocity) < _SHORT_SPEED)
        self._short = np.where(held, self._short + self._robot.dt, 0.0)
        if self._short.max() < _SHORT_SECONDS:
            return False
        worst = int(self._short.argmax())
        name = self._robot.names[worst]
        self._guard.fault(
            BLOCKED,
            f"{name} stands still {away[worst]:.2f} rad short of where it was sent: is it at a stop, or in the way of "
            "something? Give it a narrower range, or a smaller --amplitude",
            name,
        )
        return True

    def _goal(self, tick: int) -> Array | None:
        """By the clock, whatever was missed: a motion is as fast as it was planned."""
        middle = middle_pose(self._robot)
        if self._way is None:
            far = float(np.abs(middle - self._guard.applied).max())
            ticks = int(np.ceil(MIN_JERK_PEAK * far / self._robot.limits.homing_speed * self._robot.rate))
            self._way = MinJerk(self._guard.applied.copy(), middle, ticks)
            self._first = tick + max(ticks, 1) + round(_STILL_SECONDS * self._robot.rate)
        if tick < self._first:
            return self._way.next()
        at = tick - self._first
        for begin in range(self._told + 1, min(at, len(self._goals) - 1) + 1):
            if begin in self._begins:
                self._guard.note(PIECE, self._begins[begin])
        self._told = at
        if at >= len(self._goals):
            self._guard.note(PIECE, END)
            self._guard.stop("task", "done")
            return None
        goal: Array = self._goals[at]
        return goal


def record(
    body: Backend,
    handles: tuple[Sensors, Motors],
    robot: Robot,
    motions: Sequence[Exercise],
    gain: float,
    log: Path,
) -> GantryRun:
    """Do motions at a gain on a connected robot, and record them. However it ends, the robot is off then.

    Raises ConfigError where the log cannot be written, BackendError where the robot cannot be reached: the log is kept.
    """
    sensors, motors = handles
    guard = Guard(robot, motors, gain)
    recorder = Recorder.create(log, _header(robot, body.name, gain), wait=body.simulation is not None)
    events: list[Any] = []
    outcome = {"outcome": "error"}
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        stack.callback(lambda: recorder.close(outcome))
        controlled = ControlledRobot(robot, sensors, Estimator(robot), guard)
        stops = Stops(interrupt, lambda: recorder.error)
        keep = (recorder, lambda record: events.extend(record.events))
        period = round(robot.dt * 1e9)  # simulated ticks begin on a step of the physics, as when it was connected
        body.clock.sleep_until(-(-body.clock.now_ns() // period) * period)
        schedule = Schedule(body.clock, robot.rate)
        Loop(controlled, Excitation(robot, guard, motions), schedule, interrupt, stops, keep).run()
        last = guard.events()
        events.extend(last)
        recorder.events(last)
        outcome["outcome"] = guard.cause or "task"
    texts = tuple(event.text for event in events if event.kind not in ("phase", "task", PIECE))
    return GantryRun(log, guard.cause, texts)


def _header(robot: Robot, body: str, gain: float) -> dict[str, Any]:
    settings = {
        "task": "identify",
        "backend": body,
        "robot": robot.name,
        "policy": "identify",
        "seed": 0,
        "gain": gain,
        "set": {},
    }
    return {
        "format": FORMAT,
        "settings": settings,
        "task": {"name": "identify"},
        **fingerprint(robot),
        "backend": body,
        "policy": {"name": "identify"},
        "versions": versions(),
        "git_commit": git_commit(),
    }
