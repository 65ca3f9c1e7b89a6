"""The control loop: read, estimate, act, guard, write, record."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

from servoid.hw.contracts.body import Array, Observation, Sensors
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.stack.estimation.sample_hold import SampleHold, complete
from servoid.stack.log.tick import Listener, Proposal, TickRecord, Timing
from servoid.stack.runtime.clock import Schedule
from servoid.stack.runtime.interrupt import TWICE, Interrupt, Stops
from servoid.stack.runtime.operator import Operator
from servoid.stack.safety.guard import Guard


class StateEstimator(Protocol):
    """Makes states of observations; `applied` is the last accepted goal, `(n_joints,)` rad, and `ticks` is how many
    have passed since the observation before."""

    def reset(self) -> None: ...

    def reset_odometry(self) -> None: ...

    def fall(self) -> None: ...

    def stand(self) -> None: ...

    def update(self, observation: Observation, applied: Array, ticks: int) -> State: ...


class Supervisor(Protocol):
    """Decides what a run does at each tick, through the guard."""

    def act(self, tick: int, observation: Observation, state: State | None) -> Proposal: ...


@dataclass(frozen=True)
class ControlledRobot:
    """A robot that is connected, and what stands between it and whoever controls it."""

    robot: Robot
    sensors: Sensors
    estimator: StateEstimator
    guard: Guard


class Loop:
    """Runs ticks on schedule until the guard has turned torque off, whatever happens."""

    def __init__(
        self,
        controlled: ControlledRobot,
        supervisor: Supervisor,
        schedule: Schedule,
        interrupt: Interrupt,
        stops: Stops,
        listeners: tuple[Listener, ...] = (),
        operator: Operator | None = None,
    ) -> None:
        """The reasons of `stops` may include the operator's."""
        self._operator = operator
        self._sensors, self._estimator, self._guard = controlled.sensors, controlled.estimator, controlled.guard
        self._supervisor = supervisor
        self._schedule, self._interrupt, self._stops, self._listeners = schedule, interrupt, stops, listeners
        self._hold = SampleHold()
        self._estimated: int | None = None  # tick of the newest state
        self._record_ns = 0

    def run(self) -> None:
        """Raises BackendError when the body cannot be reached, and whatever a listener raises; torque is off by then,
        as far as the body can be reached."""
        try:
            while not self._guard.off:
                self.tick()
        except KeyboardInterrupt:  # a policy hung, and was broken off by the second Ctrl-C
            self._guard.note("interrupt", TWICE)
        finally:
            self._guard.release()

    def tick(self) -> None:
        wake = self._schedule.wait()
        began = time.perf_counter_ns()
        raw = self._sensors.read()
        read = time.perf_counter_ns()
        self._guard.begin(wake.tick, raw.time_ns)
        observation = self._hold.update(raw)
        state = self._estimate(wake.tick, observation) if complete(observation) else None
        estimated = time.perf_counter_ns()
        intent = None if self._operator is None else self._operator.read()
        self._heed(wake.tick)  # first: a signal that asks to stop may have ended a planner, too
        proposal = self._act(wake.tick, observation, state)
        acted = time.perf_counter_ns()
        command = self._guard.decide(observation, state, proposal.target)
        guarded = time.perf_counter_ns()
        self._guard.send()
        written = time.perf_counter_ns()
        timing = Timing(
            late=wake.late_ns,
            missed=wake.missed,
            read=read - began,
            estimate=estimated - read,
            act=acted - estimated,
            guard=guarded - acted,
            write=written - guarded,
            record=self._record_ns,
        )
        events = self._guard.events()
        record = TickRecord(wake.tick, self._guard.phase, raw, state, command, proposal, events, timing, intent)
        for listener in self._listeners:
            listener(record)
        self._record_ns = time.perf_counter_ns() - written

    def _estimate(self, tick: int, observation: Observation) -> State:
        ticks = 1 if self._estimated is None else tick - self._estimated
        self._estimated = tick
        return self._estimator.update(observation, self._guard.applied, ticks)

    def _act(self, tick: int, observation: Observation, state: State | None) -> Proposal:
        self._interrupt.breakable = True  # nothing is written here, so a hung policy may be cut off
        try:
            return self._supervisor.act(tick, observation, state)
        finally:
            self._interrupt.breakable = False

    def _heed(self, tick: int) -> None:
        stop = self._stops.at(tick)
        if stop is None or self._guard.off:
            return
        if stop.at_once:
            self._guard.note(stop.kind, stop.text)
            self._guard.release()
        else:
            self._guard.stop(stop.kind, stop.text)
