"""The guard: the only holder of the motors.

Everything else proposes targets; what reaches a servo is decided here. Its invariants, each of which has its tests in
tests/stack/safety:

1. A position that is sent ACTIVE is finite and inside the joint's range less the margin, or on its way there from a
   measured pose that was outside.
2. From one accepted goal to the next a joint moves at most `joint_speed * dt` for each elapsed tick, and for no more
   ticks than `stale`: a servo holds its goal meanwhile, so a long gap does not earn a leap. While homing the limit is
   `homing_speed`, for one tick however many were missed; `joint_speed` for a goal that gives way (9).
3. Nothing is sent before `home`; nothing that a policy proposes is sent before `start`, or while the robot falls or
   lies.
4. A target that is not finite is never sent: the last goal holds, and after PATIENCE in a row the robot is damped.
5. DAMPED and FAULT are final: DAMP, then OFF, and never ACTIVE again.
6. Samples older than `stale` ticks, or that never came, end in FAULT; so do a servo's error and, once the robot was
   brought home, tilt beyond `tilt`, where it was not asked to recover.
7. A stop that leaves time for it (Ctrl-C, the stop button, heat, a low supply, a blocked joint, a full disk, the end of
   a task) lets a walking robot come to rest, for REST_SECONDS at most, and lowers it then: lowered in mid step it often
   falls. With a joint that is blocked it takes no more steps. One that sits is not lowered, nor one that was not
   brought home, but holds the pose that it was found in: it hangs or lies.
8. Gains only go down within a run: below what was asked for where servos get hot, the supply low or a joint blocked.
   While a robot that is to recover falls and lies, they are zero, but for its arms as they come in.
9. A fall is survived only where `recover` was asked for, and only from RUNNING, or READY: it may lie as it begins,
   and is brought home lying, its joints giving way to what they push against in vain. It falls as soon as that is
   certain (falling.py). The robot is moved again when it has lain still, with the limits of 1 and 2, in at most so
   many tries and so much time (recovery.py); what ends a run ends it then too, damped at once. It runs on when it has
   stood still, on flat soles, at the home pose.

Homing is the guard's own: from the pose that the robot is in, slowly, to the home pose. So is how it stands there until
`start`: ankles that answer a tilt, as slowly (upright.py).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from servoid.hw.contracts.body import Array, Command, Mode, Motors, Observation
from servoid.hw.contracts.control import State
from servoid.hw.faults import STOP_BUTTON
from servoid.hw.robot.description import Robot
from servoid.stack.estimation.sample_hold import missing
from servoid.stack.safety.event import Event
from servoid.stack.safety.health import BLOCKED, WALKING, Health, tilt_of
from servoid.stack.safety.limits import limit
from servoid.stack.safety.lowering import lowered_pose
from servoid.stack.safety.min_jerk import MIN_JERK_PEAK, MinJerk
from servoid.stack.safety.phase import DOWN, ENDED, FOLLOWING, POWERED, Phase
from servoid.stack.safety.recovery import LOAD, TRIES, Recovery
from servoid.stack.safety.upright import Upright

ASKED = {"interrupt", "button"}  # kinds of what a person does to stop the robot
PATIENCE = 3  # targets in a row that may be not finite
REST_SECONDS = 1.5
LOWER_SECONDS = 1.5
# At rest: goals have stayed within so many rad of each other for so many s, more than a foot is up in a step.
REST_RANGE, REST_WINDOW = 0.05, 0.3
# Braked before torque goes off, so that the robot settles instead of dropping. What is fatal must be off within 0.5 s:
# that leaves 0.1 s for torque off to be acknowledged.
DAMP_SECONDS = 0.4
HOME_TOLERANCE = 0.35  # rad that a joint may be from home after homing: above any sag under the robot's own weight


class Guard:
    """Decides and sends every command. `gain` scales the servos' position gain, 1 being as configured; `recover`: a
    fall while running does not end the run."""

    def __init__(self, robot: Robot, motors: Motors, gain: float = 1.0, *, recover: bool = False) -> None:
        self.robot = robot
        self.phase = Phase.LIMP
        self.applied: Array = robot.home.copy()  # (n_joints,) rad: the last accepted goal
        self.off = False  # torque off has been sent
        self.cause: str | None = None  # kind of the event that ended the run, the first if there were several
        self.recovery = Recovery(robot) if recover else None
        self.down = False  # it fell while it ran, and has not got up
        self.sits = False  # on a seat, as its task has it; whoever runs that says so
        self.lowest = lowered_pose(robot)
        self._upright = Upright(robot)
        self._motors = motors
        self._gain = np.full(len(robot.names), gain)
        self._health = Health(robot, self._gain)
        self._events: list[Event] = []
        self._command = self._make(Mode.OFF)
        self._motion: MinJerk | None = None
        self._goals: deque[tuple[int, Array]] = deque()  # of the last ticks while stopping
        self._stopping = 0  # tick at which that began
        self._again: set[str] = set()  # kinds of the wishes to stop that came while stopping
        self._stands = True  # once it is home: so it is upright, and can be lowered
        self._rejected = 0
        self._damped_ticks = 0
        self._tick = 0  # of the newest decision
        self._accepted = 0  # tick of the last accepted goal
        self._began: int | None = None
        self._time = 0.0

    # What a run asks for ---------------------------------------------------------------------------------------------

    def home(self, observation: Observation) -> None:
        """Begin to move to the home pose from where the robot is. Raises RuntimeError unless LIMP."""
        if not self._take(observation):
            return
        distance = float(np.abs(self.robot.home - self.applied).max())
        seconds = MIN_JERK_PEAK * distance / self.robot.limits.homing_speed
        self._motion = MinJerk(self.applied, self.robot.home, math.ceil(seconds * self.robot.rate))
        self._enter(Phase.HOMING, f"homing, {seconds:.1f} s")

    def hold(self, observation: Observation) -> None:
        """Torque on in the pose that the robot is in, without going home. Raises RuntimeError unless LIMP."""
        if self._take(observation):
            self._stands = False
            self._enter(Phase.READY, "holding")

    def start(self) -> None:
        """Follow targets from now on. Raises RuntimeError unless READY."""
        self._expect(Phase.READY)
        self._enter(Phase.RUNNING, "running")

    def lie_down(self, text: str) -> None:
        """A try to get up has failed: lie still again, for the next one. Raises RuntimeError unless RECOVERING."""
        self._expect(Phase.RECOVERING)
        assert self.recovery is not None
        self.note("recovery", text)
        self.recovery.lie(self._tick)
        self._enter(Phase.FALLEN, "lying down")

    def go_on(self) -> None:
        """Follow the policy again. Raises RuntimeError unless RECOVERING, and standing at home."""
        self._expect(Phase.RECOVERING)
        if self.recovery is None or not self.recovery.home:
            raise RuntimeError("the robot does not stand at home yet")
        self.down = False
        self.note("recovery", f"it stands again after {self.recovery.tries} of {TRIES} tries")
        self._enter(Phase.RUNNING, "running again")

    def stop(self, kind: str, text: str, joint: str | None = None) -> None:
        """End in order: brought to rest and lowered if it stands, damped, off. Does nothing when it is ending."""
        if self.phase is Phase.STOPPING and kind != BLOCKED:
            if kind in ASKED and kind not in self._again:  # a person shall see that it was heard
                self.note(kind, text)
            self._again.add(kind)
            return
        if self.phase in {Phase.LOWERING, *ENDED}:
            return
        self.cause = self.cause or kind
        self.note(kind, text, joint)
        stands = self._stands and not self.sits
        if self.phase is Phase.RUNNING and stands and kind != BLOCKED:
            self._stopping = self._tick
            self._again.add(kind)
            self._enter(Phase.STOPPING, "coming to rest")
        elif self.phase in {Phase.READY, *FOLLOWING} and stands:
            self._lower()
        else:  # seated, limp, held, fallen or on the way home, as it may hang or lie: a crouch would be one more motion
            self._enter(Phase.DAMPED, "damped")

    def give_up(self, text: str, joint: str | None = None) -> None:
        """Of a policy that fails: damped; but where the robot is coming to rest, do not wait for that and lower it."""
        if self.phase is Phase.STOPPING:
            self.note("policy", text, joint)
            self._lower()
        else:
            self.fault("policy", text, joint)

    def fault(self, kind: str, text: str, joint: str | None = None) -> None:
        """End at once: damped, then off."""
        if self.phase in ENDED:
            return
        self.cause = self.cause or kind
        self.note(kind, text, joint)
        self._enter(Phase.FAULT, f"damped: {text}")

    def release(self) -> None:
        """Damp and turn torque off at once, both tried even if one fails. Raises the first BackendError at the end."""
        if self.phase not in ENDED:
            self.cause = self.cause or "interrupt"
            self._enter(Phase.DAMPED, "released")
        if self.off:
            return
        failure: Exception | None = None
        for mode in (Mode.DAMP, Mode.OFF):
            self._command = self._make(mode)
            try:
                self._motors.write(self._command)
            except Exception as error:  # the second write is the one that matters
                failure = failure or error
        if failure is not None:
            raise failure
        self.off = True

    # One tick --------------------------------------------------------------------------------------------------------

    def begin(self, tick: int, time_ns: int) -> None:
        """A new tick, at a time of the loop's clock."""
        self._tick = tick
        self._began = time_ns if self._began is None else self._began
        self._time = (time_ns - self._began) * 1e-9

    def decide(self, observation: Observation, state: State | None, target: Array | None) -> Command:
        """What to send at this tick.

        `observation` holds the newest sample of each joint and its age; `state` is read for tilt and turning, and is
        None while there is not a sample of everything yet; `target` `(n_joints,)` rad is what a policy proposes and is
        looked at only in RUNNING, RECOVERING and STOPPING, where None proposes nothing and the goal holds.
        """
        if self.phase in POWERED:
            self._check(observation, state)
        if self.phase is Phase.RUNNING and self.recovery is not None and state is not None:
            why = self.recovery.falls(state, self._tick)
            if why is not None:  # as soon as it is certain: so there is time for the arms to come in
                self._fall(why)
        if self.phase in DOWN:
            self._watch_recovery(observation, state)
        if self.phase is Phase.STOPPING and self._rests():
            self._lower()
        if self.phase in {Phase.RECOVERING, *FOLLOWING} and target is not None:
            self._accept(target)
        elif self.phase in {Phase.READY, Phase.RECOVERING, *FOLLOWING}:
            self._accepted = self._tick  # a goal that is held is accepted anew: time spent holding earns no leap
            if self.phase is Phase.READY and self._stands and state is not None:
                self.applied = self._upright.goal(state, self.applied)
        elif self.phase is Phase.HOMING:
            self._home_on(observation, state)
        elif self.phase is Phase.LOWERING:
            self._lower_on()
        if self.phase in POWERED:
            self._command = self._make(Mode.ACTIVE)
        elif self.phase in ENDED:
            self._damped_ticks += 1
            braking = not self.off and self._damped_ticks <= DAMP_SECONDS * self.robot.rate
            self._command = self._make(Mode.DAMP if braking else Mode.OFF)
        return self._command

    def send(self) -> None:
        """Write what was decided. Takes no argument, so that nobody else's command can pass. Raises BackendError."""
        if self.phase is Phase.LIMP or self.off:
            return
        self._motors.write(self._command)
        self.off = self._command.mode is Mode.OFF

    def events(self) -> tuple[Event, ...]:
        """Events since the last call."""
        taken, self._events = tuple(self._events), []
        return taken

    def note(self, kind: str, text: str, joint: str | None = None) -> None:
        """Add an event at the present tick."""
        self._events.append(Event(self._tick, self._time, kind, joint, text))

    # How -------------------------------------------------------------------------------------------------------------

    def _take(self, observation: Observation) -> bool:
        """Begin from the pose that the robot is in; False, and an end, where that is not known or the stop button is
        pressed."""
        self._expect(Phase.LIMP)
        lacking = missing(observation, self.robot.names)
        if lacking:
            self.fault("stale", f"no valid sample from {', '.join(lacking)}: check the cable and the power", lacking[0])
            return False
        if (observation.fault & STOP_BUTTON).any():
            self.stop("button", "the stop button was pressed before the robot began: let go of it and start again")
            return False
        self.applied = np.array(observation.position, dtype=float)
        self._accepted = self._tick
        return True

    def _accept(self, target: Array) -> None:
        proposal = np.asarray(target, dtype=float)
        if proposal.shape != self.applied.shape:
            self.give_up(f"a target of shape {proposal.shape}, but the robot has {len(self.applied)} joints")
            return
        bad = np.flatnonzero(~np.isfinite(proposal))
        if bad.size:
            self._rejected += 1
            joint = self.robot.names[bad[0]]
            if self._rejected == 1:
                self.note("rejected", f"target of {joint} is {proposal[bad[0]]}: the last goal holds", joint)
            if self._rejected >= PATIENCE:
                self.give_up(f"{PATIENCE} targets in a row are not finite, the last for {joint}", joint)
            return
        self._rejected = 0
        self.applied = limit(proposal, self.applied, self.robot, self._elapsed())
        self._accepted = self._tick

    def _home_on(self, observation: Observation, state: State | None) -> None:
        assert self._motion is not None
        self._accepted = self._tick
        lies = self.recovery is not None and tilt_of(observation, state) > self.robot.limits.tilt
        if self._motion.done and (lies or np.allclose(self.applied, self.robot.home, rtol=0.0, atol=1e-9)):
            error = np.abs(observation.position - self.robot.home)
            worst, name = int(error.argmax()), self.robot.names[int(error.argmax())]
            if error[worst] > HOME_TOLERANCE and not lies:
                self.fault("homing", f"{name} is {error[worst]:.2f} rad from home: is it blocked or unpowered?", name)
            else:
                self._enter(Phase.READY, "ready")
            return
        before, rates = self.applied, self.robot.limits
        slow, fast = rates.homing_speed * self.robot.dt, rates.joint_speed * self.robot.dt
        self.applied = np.clip(self._motion.next(), before - slow, before + slow)
        if lies:  # perhaps on a limb, which no strength of its own frees
            self.applied = np.clip(self._health.eased(self.applied, observation.position), before - fast, before + fast)

    def _rests(self) -> bool:
        """Whether a robot that is stopping has come to rest, or had its time."""
        if self._tick - self._stopping >= REST_SECONDS * self.robot.rate:
            return True
        window = REST_WINDOW * self.robot.rate
        self._goals.append((self._tick, self.applied))
        while len(self._goals) > 1 and self._tick - self._goals[1][0] >= window:
            self._goals.popleft()
        goals = [goal for _, goal in self._goals]
        return self._tick - self._goals[0][0] >= window and float(np.ptp(goals, axis=0).max()) < REST_RANGE

    def _fall(self, text: str) -> None:
        """Falling while it ran, of a robot that is to get up again."""
        assert self.recovery is not None
        self.down = True
        self.note("fall", text)
        self.recovery.fall(self._tick)
        self._enter(Phase.FALLEN, "falling: gains down, arms in")

    def _watch_recovery(self, observation: Observation, state: State | None) -> None:
        """What becomes of a robot that is down: it is left lying, begins to get up, or goes limp with its joints."""
        recovery = self.recovery
        assert recovery is not None
        recovery.watch(observation, state, self._tick)
        lying = self.phase is Phase.FALLEN
        if (why := recovery.hopeless(lying)) is not None:
            self.fault("fall", why)
        elif lying and recovery.lies:
            recovery.rise()
            self._enter(Phase.RECOVERING, f"getting up, try {recovery.tries} of {TRIES}")
        elif lying:
            self.applied = limit(recovery.goal(observation.position), self.applied, self.robot, self._elapsed())
            self._accepted = self._tick

    def _lower(self) -> None:
        self._motion = MinJerk(self.applied, self.lowest, round(LOWER_SECONDS * self.robot.rate))
        self._enter(Phase.LOWERING, "lowering")

    def _lower_on(self) -> None:
        assert self._motion is not None
        if self._motion.done:
            self._enter(Phase.DAMPED, "damped")
            return
        self.applied = limit(self._motion.next(), self.applied, self.robot, self._elapsed())
        self._accepted = self._tick

    def _check(self, observation: Observation, state: State | None) -> None:
        """Act on what is wrong. On the way home, or held as it was found, the robot may hang from a hand, tilted."""
        upright = self._stands and self.phase not in {Phase.HOMING, *DOWN}
        load = None if self.phase is Phase.FALLEN else LOAD if self.phase is Phase.RECOVERING else WALKING
        found = self._health.examine(observation, state, self.applied, upright=upright, load=load)
        for ends, kind, text, joint in found:
            if kind == "fall" and self.recovery is not None and self.phase in {Phase.READY, Phase.RUNNING}:
                self._fall(text)
            elif ends == "now" and self.phase not in ENDED:
                self.fault(kind, text, joint)
            elif ends == "lowered":
                self.stop(kind, text, joint)
            else:
                self.note(kind, text, joint)

    def _elapsed(self) -> int:
        return min(max(1, self._tick - self._accepted), self.robot.limits.stale)

    def _make(self, mode: Mode) -> Command:
        gain = self._gain * self._health.factor
        if self.phase is Phase.FALLEN and self.recovery is not None:
            gain = gain * self.recovery.gain
        return Command(position=self.applied, gain=gain, mode=mode)

    def _enter(self, phase: Phase, text: str) -> None:
        if self.phase is Phase.LIMP and phase in ENDED:
            self.off = True  # torque was never on: there is nothing to brake
        self.phase = phase
        self.note("phase", text)

    def _expect(self, phase: Phase) -> None:
        if self.phase is not phase:
            raise RuntimeError(f"the guard is {self.phase}, not {phase}")
