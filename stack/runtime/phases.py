"""The phases of a run: home, stand still, do the task, come to rest, end."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import Observation
from servoid.hw.contracts.control import Instruction, Policy, State
from servoid.hw.contracts.task import Assignment, Behaviour, Trace
from servoid.hw.contracts.world import Percept
from servoid.stack.control.get_up import GetUp
from servoid.stack.estimation.sample_hold import missing
from servoid.stack.log.tick import Proposal
from servoid.stack.log.trace_buffer import TraceBuffer
from servoid.stack.runtime.loop import ControlledRobot
from servoid.stack.safety.phase import DOWN, Phase

SITS = 0.88  # of the standing height: lower than that, a robot that may sit does
WAIT_SECONDS = 1.0  # for a first sample from every sensor
STILL_SECONDS = 0.5  # after homing, when the body has stopped swinging: gravity is taken from there, not from the way
DONE = "the task is done"
SETTLE_SECONDS = 1.5  # standing still at home, in which the estimator learns the gyro's bias


@dataclass(frozen=True)
class Recovering:
    """What a run that goes on after a fall needs: what gets the robot up, and lets the policy begin anew."""

    get_up: GetUp
    begin_policy: Callable[[], None]


class Phases:
    """Supervises a run. On hardware, without a `simulation`, nothing pushes the robot; where no surroundings are seen,
    the behaviour says what should be there. Without `recovering`, which a guard that recovers asks for, a fall is the
    end."""

    def __init__(
        self,
        controlled: ControlledRobot,
        assignment: Assignment,
        behaviour: Behaviour,
        policy: Policy,
        simulation: Simulation | None = None,
        recovering: Recovering | None = None,
    ) -> None:
        self._robot, self._guard, self._estimator = controlled.robot, controlled.guard, controlled.estimator
        self._behaviour, self._policy, self._simulation = behaviour, policy, simulation
        self._seconds, self._pushes = assignment.task.seconds, assignment.episode.pushes
        surroundings = None if simulation is None else simulation.surroundings
        self._look = behaviour.percept if surroundings is None else surroundings.look
        self._kind = "skill" if assignment.task.performs else "plan"  # of events that the policy tells
        self._may_sit = assignment.episode.seated
        self._steered, self._recovering = assignment.task.steered, recovering
        self._before = Phase.LIMP  # the guard's phase at the last tick
        self._settled = 0
        self._lost: str | None = None  # a skill that was asked for while the robot was down, and still is
        self._buffer = TraceBuffer(len(self._robot.joints), round(self._seconds / self._robot.dt))
        self.ended: str | None = None  # "done" or "time", if the task ended by itself

    @property
    def task_ticks(self) -> int:
        return len(self._buffer)

    def act(self, tick: int, observation: Observation, state: State | None) -> Proposal:
        phase = self._guard.phase
        before, self._before = self._before, phase
        if phase is Phase.LIMP:
            self._wake(tick, observation, state)
        elif phase is Phase.READY:
            self._settled += 1
            if self._settled == round(STILL_SECONDS * self._robot.rate):
                self._estimator.reset()
            if self._settled >= SETTLE_SECONDS * self._robot.rate:
                self._estimator.reset_odometry()
                self._guard.start()
        elif phase is Phase.RUNNING and state is not None:
            low = float(state.displacement[2]) < SITS * self._robot.standing_height
            self._guard.sits = self._may_sit and low
            return self._do_task(state)
        elif phase is Phase.STOPPING and state is not None:
            return self._come_to_rest(state)
        elif phase in DOWN and state is not None:
            return self._recover(phase, before, state)
        return Proposal()

    def trace(self) -> Trace:
        """What the robot believes to have gone through in the task."""
        fell = self._guard.phase is Phase.FAULT and self._guard.cause == "fall" and self.ended is None
        return self._buffer.trace(self._robot.dt, fell or self._guard.down)

    def _wake(self, tick: int, observation: Observation, state: State | None) -> None:
        if state is not None:
            self._guard.home(observation)
        elif tick >= WAIT_SECONDS * self._robot.rate:
            lacking = ", ".join(missing(observation, self._robot.names))
            self._guard.fault("stale", f"no sample from {lacking}: check cables and power")

    def _ask(self, state: State) -> tuple[Instruction, Percept, bool] | None:
        """What the task asks at this tick, what is seen, and whether it is done; None where it failed: the run ends."""
        try:
            percept = self._look(state)
            instruction = self._behaviour.instruct(self.task_ticks, state, percept)
            for text in self._behaviour.take_events():
                self._guard.note("act", text)
            if instruction.skill is not None:
                instruction = replace(instruction, skill=self._possible(instruction.skill))
            else:
                self._lost = None
            self._buffer.add(state, instruction, percept)
            done = self._behaviour.done(state)
        except Exception as error:  # whatever a task raises, the robot must end safe
            self._guard.give_up(_failed("task", error))
            return None
        return instruction, percept, done

    def _possible(self, skill: str) -> str | None:
        """A skill that may be performed: none while the robot is down, nor the one that it fell with or was asked for
        then, until that is asked for anew."""
        if self._guard.down and skill != self._lost:
            self._lost = skill
            self._guard.note("skill", f"'{skill}' is refused: the robot lies; ask again when it stands")
        return None if skill == self._lost else skill

    def _do_task(self, state: State) -> Proposal:
        tick = self.task_ticks
        if (asked := self._ask(state)) is None:
            return Proposal()
        instruction, percept, done = asked
        shown = Proposal(instruction=instruction, percept=percept)
        if done:
            return self._end("done", DONE, shown, state)
        if tick * self._robot.dt >= self._seconds:
            return self._end("time", f"{self._seconds:g} s are over", shown, state)
        self._push(tick)
        try:
            target = self._policy.act(state, self._guard.applied, instruction)
        except Exception as error:  # whatever a controller raises, the robot must end safe
            self._guard.give_up(_failed("policy", error))
            return shown
        self._tell()
        return replace(shown, target=target, plan=self._policy.adopted)

    def _push(self, tick: int) -> None:
        velocity = self._pushes.get(tick)
        if velocity is not None and self._simulation is not None:
            self._simulation.push(velocity)

    def _recover(self, phase: Phase, before: Phase, state: State) -> Proposal:
        """Get up, while the task's time runs on, and its pushes come."""
        recovering, recovery, tick = self._recovering, self._guard.recovery, self.task_ticks
        assert recovering is not None
        assert recovery is not None
        if before is Phase.READY:  # it lies as it begins
            self._estimator.reset_odometry()
        if before in {Phase.READY, Phase.RUNNING}:
            self._estimator.fall()
        if (asked := self._ask(state)) is None:
            return Proposal()
        instruction, percept, done = asked
        shown = Proposal(instruction=instruction, percept=percept)
        if done and self._steered:  # by a person who wants it to end; no robot reaches anything by lying there
            self.ended = "done"
            self._guard.stop("task", DONE)
            return shown
        if tick * self._robot.dt >= self._seconds:
            self._guard.fault("fall", f"{self._seconds:g} s are over, and the robot has not got up")
            return shown
        self._push(tick)
        if phase is Phase.FALLEN:
            recovering.get_up.begin()
            return shown
        if recovery.home:
            self._estimator.stand()
            recovering.begin_policy()
            self._guard.go_on()
            return shown
        target = recovering.get_up.act(state, self._guard.applied, recovery)
        if target is None:
            self._guard.lie_down(f"try {recovery.tries} failed: {recovering.get_up.failed}")
        return replace(shown, target=target)

    def _come_to_rest(self, state: State) -> Proposal:
        """Ask the policy to stand."""
        try:
            target = self._policy.act(state, self._guard.applied, Instruction(np.zeros(3), stand=True))
        except Exception as error:
            self._guard.give_up(_failed("policy", error))
            return Proposal()
        self._tell()
        return Proposal(target, plan=self._policy.adopted)

    def _tell(self) -> None:
        """What the policy wants a person to know, as events."""
        for text in self._policy.take_events():
            self._guard.note(self._kind, text)

    def _end(self, how: str, text: str, shown: Proposal, state: State) -> Proposal:
        """End the task. The policy is asked at this tick too: a walking robot has no time for a tick without."""
        self.ended = how
        self._guard.stop("task", text)
        if self._guard.phase is not Phase.STOPPING:
            return shown
        return replace(self._come_to_rest(state), instruction=shown.instruction, percept=shown.percept)


def _failed(what: str, error: Exception) -> str:
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"the {what} failed: {type(error).__name__}: {error} ({where.filename}:{where.lineno})"
