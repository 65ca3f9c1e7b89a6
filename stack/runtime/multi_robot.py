"""The other robots of a run: each runs the whole stack on a body of its own, between two steps of the world."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.body import Clock
from servoid.hw.contracts.control import Policy
from servoid.hw.contracts.task import Task
from servoid.hw.robot.description import Robot
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.estimation.odometry import load_odometry
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.clock import Schedule
from servoid.stack.runtime.interrupt import Interrupt, Stops
from servoid.stack.runtime.loop import Loop
from servoid.stack.runtime.phases import Phases
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import ENDED, Guard, Phase

_ENDING = {Phase.STOPPING, Phase.LOWERING, *ENDED}
_QUIET = {"phase", "task", "first"}  # kinds of events of others that the first robot's log does without


@dataclass(frozen=True)
class _Member:
    number: int
    task: Task
    guard: Guard
    loop: Loop


class Others:
    """Robots 1 and on. They do their tasks for as long as the first robot, number 0, does its own.

    Call it with each tick of the first robot, whose log also tells what happens to them. As a Clock it is the world's,
    for the first robot's loop: before each tick that goes by, the others do theirs. All that they do depends on nothing
    but the run's ticks, so that it can be repeated.
    """

    def __init__(
        self,
        robot: Robot,
        body: Backend,
        tasks: tuple[Task, ...],
        make: Callable[[Task], Policy],
        first: Guard,
        interrupt: Interrupt,
        seed: int,
        gain: float,
    ) -> None:
        """`body` is the first robot's, whose world has a body for each of `tasks`; `make` makes a policy for a task."""
        assert body.simulation is not None
        self._first, self._interrupt, self._robot = first, interrupt, robot
        self._clock: Clock = body.clock
        self._heard: list[Event] = []  # why the first robot ended: the others end with it
        self._open = ExitStack()
        self._members: list[_Member] = []
        for number, (task, other) in enumerate(zip(tasks, body.simulation.teammates, strict=True), 1):
            policy = make(task)
            self._open.callback(policy.close)
            policy.reset(None, np.random.SeedSequence([seed, number]).generate_state(1)[0])
            sensors, motors = other.connect()
            self._open.callback(other.close)
            guard = Guard(robot, motors, gain)
            estimator = Estimator(robot, load_odometry(robot))
            assert other.simulation is not None
            assert other.simulation.surroundings is not None
            look = other.simulation.surroundings.look
            phases = Phases(robot, guard, estimator, task, policy, None, look)
            schedule = Schedule(other.clock, robot.rate)
            stops = Stops(Interrupt(), script=self._heard)
            loop = Loop(sensors, estimator, phases, guard, schedule, interrupt, stops, (self._listener(number),))
            self._members.append(_Member(number, task, guard, loop))

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
                member.task.lost()

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
