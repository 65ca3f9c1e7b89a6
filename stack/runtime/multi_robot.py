"""The other robots of a run: each runs the whole stack on a body of its own, between two steps of the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.body import Clock
from servoid.hw.contracts.task import Assignment, Behaviour
from servoid.hw.seeds import teammate_seed
from servoid.stack.control.policies import make_policy
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.estimation.odometry import odometry_of
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.clock import Schedule
from servoid.stack.runtime.interrupt import Interrupt, Stops
from servoid.stack.runtime.loop import ControlledRobot, Loop
from servoid.stack.runtime.phases import Phases
from servoid.stack.runtime.settings import RunSettings, Script
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.phase import ENDED, Phase

_ENDING = {Phase.STOPPING, Phase.LOWERING, *ENDED}
_QUIET = {"phase", "task", "first"}  # kinds of events of others that the first robot's log does without


@dataclass(frozen=True)
class _Member:
    behaviour: Behaviour
    guard: Guard
    loop: Loop


class Teammates:
    """Robots 1 and on. They do their tasks for as long as the first robot, number 0, does its own.

    Call it with each tick of the first robot, whose log also tells what happens to them. As a Clock it is the world's,
    for the first robot's loop: before each tick that goes by, the others do theirs. All that they do depends on nothing
    but the run's ticks, so that it can be repeated.
    """

    def __init__(
        self,
        settings: RunSettings,
        assignment: Assignment,
        behaviours: Sequence[Behaviour],
        body: Backend,
        first: ControlledRobot,
        interrupt: Interrupt,
        script: Script,
    ) -> None:
        """`body` is the first robot's, whose world has a body for each of `behaviours`."""
        assert body.simulation is not None
        robot = self._robot = first.robot
        self._first, self._interrupt = first.guard, interrupt
        self._clock: Clock = body.clock
        self._heard: list[Event] = []  # why the first robot ended: the others end with it
        self._open = ExitStack()
        self._members: list[_Member] = []
        unpushed = replace(assignment, episode=replace(assignment.episode, pushes={}))  # it is the first that is pushed
        for number, (behaviour, other) in enumerate(zip(behaviours, body.simulation.teammates, strict=True), 1):
            # Its planner never runs beside the loop: the log, which is the first robot's, has to repeat it.
            policy = make_policy(settings.policy, robot, assignment.task, realtime=False, planner=script.planner)
            self._open.callback(policy.close)
            policy.reset(None, np.array(teammate_seed(settings.seed, number)))
            sensors, motors = other.connect()
            self._open.callback(other.close)
            guard = Guard(robot, motors, settings.gain)
            controlled = ControlledRobot(robot, sensors, Estimator(robot, odometry_of(robot)[0]), guard)
            phases = Phases(controlled, unpushed, behaviour, policy, other.simulation)
            schedule, stops = Schedule(other.clock, robot.rate), Stops(Interrupt(), script=self._heard)
            loop = Loop(controlled, phases, schedule, interrupt, stops, (self._listener(number),))
            self._members.append(_Member(behaviour, guard, loop))

    def __call__(self, record: TickRecord) -> None:
        if record.phase in _ENDING and not self._heard:
            self._heard.append(Event(record.tick, 0.0, "first", None, "the first robot's run has ended"))

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def sleep_until(self, time_ns: int) -> None:
        """Let time go on tick by tick, as far as whole ones fit."""
        tick = round(1e9 / self._robot.rate)
        while (now := self.now_ns()) + tick <= time_ns:
            self._tick()
            self._clock.sleep_until(now + tick)

    def _tick(self) -> None:
        """Let each robot that has not ended do its tick."""
        for member in self._members:
            if not member.guard.off:
                member.loop.tick()
            if member.guard.phase in _ENDING:
                member.behaviour.lost()

    def finish(self) -> None:
        """Time goes on until all have been lowered; at once off where a person interrupted twice."""
        with suppress(KeyboardInterrupt):  # a second Ctrl-C: `close` turns torque off
            while self._interrupt.count < 2 and not all(member.guard.off for member in self._members):
                self.sleep_until(self.now_ns() + round(1e9 / self._robot.rate))

    def close(self) -> None:
        """Torque off, whatever happened."""
        for member in self._members:
            self._open.callback(member.guard.release)
        self._open.close()

    def _listener(self, number: int) -> Callable[[TickRecord], None]:
        def tell(record: TickRecord) -> None:
            for event in record.events:
                if event.kind not in _QUIET:
                    self._first.note("robot", f"robot {number}: {event.text}", event.joint)

        return tell
