"""One joint moved a little by a person at a terminal: a supervisor for the loop, and limits that the guard enforces.

Nothing here writes to a motor. The guard gets a robot whose joints can only be where they are, all but one, and that
one slow and near: whatever the supervisor proposes, no more than that is sent.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import sys
import termios
import tty
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

from servoid.hw.contracts.body import Array, Observation
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.stack.estimation.sample_hold import missing
from servoid.stack.log.tick import Proposal
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.phase import Phase

SPEED = 0.25  # rad/s
SPAN = 0.35  # rad that the joint may go from where it was found, either way
KEY_SECONDS = 0.12  # that a key moves the joint: a held one repeats at least every 0.1 s, and a released one no more
IDLE_SECONDS = 60.0  # without a key until torque goes off: a held robot gets warm
WAIT_SECONDS = 1.0  # for a first sample of everything
SETTLE_SECONDS = 0.3  # between torque and the first motion
PAUSE_SECONDS = 1.0  # at the far end of a motion that was asked for on the command line
SPARE_SECONDS = 2.0  # that such a motion may take beyond its way and the pause


@dataclass(frozen=True)
class Wish:
    """What the person wants now: to move at a share of SPEED, -1..1, or to end."""

    rate: float = 0.0
    ends: bool = False

    HOLD: ClassVar[Wish]
    UP: ClassVar[Wish]
    DOWN: ClassVar[Wish]
    END: ClassVar[Wish]


Wish.HOLD, Wish.UP, Wish.DOWN, Wish.END = Wish(), Wish(1.0), Wish(-1.0), Wish(ends=True)


class Source(Protocol):
    """Where wishes come from. `seconds` is time since the first question, `angle` the joint's goal [rad]."""

    def wish(self, seconds: float, angle: float) -> Wish: ...


def restrict(robot: Robot, position: Array, i: int) -> Robot:
    """The robot for the guard of a jog: joint `i` within SPAN of `position` `(n_joints,)` rad and its own range, at
    SPEED; the others where they are."""
    margin = robot.limits.margin
    joints = []
    for number, (joint, here) in enumerate(zip(robot.joints, position.tolist(), strict=True)):
        low = high = here
        if number == i:
            low = min(here, max(here - SPAN, joint.range[0] + margin))
            high = max(here, min(here + SPAN, joint.range[1] - margin))
        joints.append(replace(joint, range=(low - margin, high + margin)))
    limits = replace(robot.limits, joint_speed=SPEED)
    return replace(robot, joints=tuple(joints), limits=limits)


def reach(restricted: Robot, i: int) -> tuple[float, float]:
    """Lowest and highest angle [rad] that joint `i` of a restricted robot can be sent to."""
    low, high = restricted.joints[i].range
    return low + restricted.limits.margin, high - restricted.limits.margin


class JogSupervisor:
    """Supervises a jog of joint `i`: holds the robot where it is, then does what `source` wishes."""

    def __init__(self, robot: Robot, guard: Guard, i: int, source: Source) -> None:
        self._robot, self._guard, self._i, self._source = robot, guard, i, source
        self._began: int | None = None  # tick of the first wish
        self._held = 0
        self._last = 0

    def act(self, tick: int, observation: Observation, state: State | None) -> Proposal:
        guard, dt = self._guard, self._robot.dt
        if guard.phase is Phase.LIMP:
            if state is not None:
                guard.hold(observation)
            elif tick * dt >= WAIT_SECONDS:
                lacking = ", ".join(missing(observation, self._robot.names))
                guard.fault("stale", f"no sample from {lacking}: check cables and power")
        elif guard.phase is Phase.READY:
            self._held += 1
            if self._held * dt >= SETTLE_SECONDS:
                guard.start()
        elif guard.phase is Phase.RUNNING:
            return self._move(tick)
        return Proposal()

    def _move(self, tick: int) -> Proposal:
        if self._began is None:
            self._began = self._last = tick
        wish = self._source.wish((tick - self._began) * self._robot.dt, float(self._guard.applied[self._i]))
        ticks, self._last = tick - self._last, tick
        if wish.ends:
            self._guard.stop("task", "done")
            return Proposal()
        target = self._guard.applied.copy()
        if wish.rate:
            target[self._i] += wish.rate * SPEED * self._robot.dt * max(1, ticks)
        return Proposal(target)


class There:
    """Goes by an angle [rad], in ticks of `dt` [s], waits there, comes back, and ends. Where the guard lets the joint
    go no further, it has arrived; however it goes, it ends."""

    def __init__(self, by: float, dt: float) -> None:
        self._by, self._near = by, SPEED * dt / 2  # half a tick's way
        self._longest = 2.0 * abs(by) / SPEED + PAUSE_SECONDS + SPARE_SECONDS  # s
        self._start: float | None = None
        self._arrived: float | None = None
        self._before: float | None = None  # the angle when it was told to move last

    def wish(self, seconds: float, angle: float) -> Wish:
        if self._start is None:
            self._start = angle
        if seconds >= self._longest:
            return Wish.END
        if self._arrived is None:
            if (wish := self._toward(self._start + self._by, angle, self._by)) is not Wish.HOLD:
                return wish
            self._arrived = seconds
        if seconds - self._arrived < PAUSE_SECONDS:
            return Wish.HOLD
        wish = self._toward(self._start, angle, -self._by)
        return Wish.END if wish is Wish.HOLD else wish

    def _toward(self, goal: float, angle: float, way: float) -> Wish:
        """The way to a goal; HOLD once there. Never turning round: it would swing about the goal."""
        there = math.copysign(1.0, way) * (goal - angle) <= self._near or angle == self._before
        self._before = None if there else angle
        if there:
            return Wish.HOLD
        return Wish.UP if way > 0.0 else Wish.DOWN


class Keys:
    """Keys of the terminal at standard input, while it is entered: arrows or + and - move, q ends."""

    _WISHES = {b"\x1b[A": Wish.UP, b"\x1b[C": Wish.UP, b"+": Wish.UP, b"=": Wish.UP, b"\x1b[B": Wish.DOWN} | {
        b"\x1b[D": Wish.DOWN, b"-": Wish.DOWN, b"q": Wish.END, b"Q": Wish.END
    }  # fmt: skip

    def __init__(self) -> None:
        self._descriptor = sys.stdin.fileno()
        self._before: list[Any] = []
        self._wish = Wish.HOLD
        self._pressed = 0.0

    def __enter__(self) -> Keys:
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        termios.tcflush(self._descriptor, termios.TCIFLUSH)  # keys that were meant for something else
        return self

    def __exit__(self, *exception: object) -> None:
        with contextlib.suppress(termios.error):  # a terminal that is gone needs nothing any more
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def wish(self, seconds: float, angle: float) -> Wish:
        """The newest key counts, for KEY_SECONDS: many that come at once over a slow line move no further than one."""
        newest = self._newest()
        if newest is not None:
            self._wish, self._pressed = newest, seconds
        idle = seconds - self._pressed
        if self._wish is Wish.END or idle >= IDLE_SECONDS:
            return Wish.END
        return self._wish if idle < KEY_SECONDS else Wish.HOLD

    def _newest(self) -> Wish | None:
        typed = b""
        while select.select([self._descriptor], [], [], 0)[0]:
            try:
                piece = os.read(self._descriptor, 256)
            except OSError:
                piece = b""
            if not piece:  # the terminal is gone
                return Wish.END
            typed += piece
        if b"q" in typed.lower():
            return Wish.END
        last = max(self._WISHES, key=typed.rfind)
        return self._WISHES[last] if last in typed else None
