"""What the guard lets a robot do that has fallen and shall get up again: for how long, how often, and when it stands.

A fall takes a few tenths of a second. In them the arms come in, softly, and the legs give; then all joints brake, until
the robot lies still. From there a controller may move it (RECOVERING), and only on its feet, at rest and at home does
it go on with what it did.
"""

from __future__ import annotations

import math

import numpy as np

from servoid.hw.contracts.body import Array, Observation
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.stack.safety.falling import Falling
from servoid.stack.safety.health import Load

TRIES = 3
SECONDS = 20.0  # from the fall until it stands, all tries together
BRACE_SECONDS = 0.4  # from the limit of tilt to the ground: a pendulum of the robot's height takes 0.2 to 0.3
BRACE_GAIN = 0.25  # of the arms meanwhile: enough to bring them in, too little to push against the ground
STILL_SECONDS = 0.5
STILL_JOINTS, STILL_BASE = 0.3, 0.3  # rad/s: ten times what a resting servo's velocity and gyro read
RESTLESS_SECONDS = 3.0  # of lying without being still: it is held, carried or rolls
UPRIGHT = 0.35  # rad that a standing base may lean
FLAT = 0.2  # rad between a standing robot's soles and the ground, by the legs
AT_HOME = 0.35  # rad that a joint may be from home when the task goes on, as after homing
# Getting up, knees and elbows push against the ground with all they have for longer than in any step; a servo shuts
# itself down after 1 s. Gains do not go down before: a leg that goes soft in mid rise lets the robot drop.
LOAD = Load(soft=math.inf, blocked=0.8)


class Recovery:
    """Counts falls' tries and times, and watches whether the robot lies still or stands."""

    def __init__(self, robot: Robot) -> None:
        self.tries = 0  # of the present fall
        self.stands = False  # upright on flat soles, and still, for STILL_SECONDS
        self.home = False  # and at the home pose
        self._robot, self._legs = robot, Legs(robot)
        self._falling = Falling(self._legs, robot.rate)
        self._arms = np.ones(len(robot.names), bool)
        self._arms[robot.leg_index.ravel()] = False
        self._fell = self._lay = 0  # ticks at which it fell, and last began to lie
        self._still = self._standing = 0  # ticks in a row
        self._tick = 0

    def falls(self, state: State, tick: int) -> str | None:
        """Why a robot that runs counts as falling, or lying, at this tick; None where it does not."""
        passed, self._tick = min(max(tick - self._tick, 1), self._robot.limits.stale), tick
        return self._falling.watch(state, passed)

    def fall(self, tick: int) -> None:
        """It falls: its tries and its time begin."""
        self.tries, self._fell = 0, tick
        self._falling.reset()
        self.lie(tick)

    def lie(self, tick: int) -> None:
        """From now on it lies, or falls to the ground."""
        self._tick = self._lay = tick
        self._still = self._standing = 0
        self.stands = self.home = False

    def rise(self) -> None:
        """A try begins."""
        self.tries += 1
        self._standing = 0

    def watch(self, observation: Observation, state: State | None, tick: int) -> None:
        """See whether it is still, and whether it stands, at this tick."""
        passed, self._tick = tick - self._tick, tick
        quiet = state is not None and bool(
            (np.abs(observation.velocity) < STILL_JOINTS).all() and np.linalg.norm(state.angular_velocity) < STILL_BASE
        )
        self._still = self._still + passed if quiet else 0
        self._standing = self._standing + passed if quiet and state is not None and self._on_feet(state) else 0
        self.stands = self._standing >= STILL_SECONDS * self._robot.rate
        self.home = self.stands and float(np.abs(observation.position - self._robot.home).max()) < AT_HOME

    def _on_feet(self, state: State) -> bool:
        up = -state.gravity
        if up[2] < math.cos(UPRIGHT):
            return False
        _, rotation, _, _ = self._legs.forward(self._legs.pick(state.position))
        return bool((rotation[..., 2] @ up > math.cos(FLAT)).all())

    @property
    def braced(self) -> bool:
        """Whether the arms have had their time to come in."""
        return self._tick - self._lay >= BRACE_SECONDS * self._robot.rate

    @property
    def gain(self) -> Array:
        """What gains `(n_joints,)` are multiplied by while it falls and lies: zero brakes."""
        return np.where(self._arms & (not self.braced), BRACE_GAIN, 0.0)

    def goal(self, position: Array) -> Array:
        """Where goals `(n_joints,)` rad go while it falls and lies: arms home first, and then with the joints, which
        are at `position`: so nothing leaps when gains come back."""
        return np.where(self._arms & (not self.braced), self._robot.home, position)

    @property
    def lies(self) -> bool:
        """Whether it has been still for long enough, its arms at rest."""
        return self.braced and self._still >= STILL_SECONDS * self._robot.rate

    def hopeless(self, lying: bool) -> str | None:
        """Why it is to be left lying, where it is; `lying`: no try is on."""
        rate = self._robot.rate
        if self._tick - self._fell >= SECONDS * rate:
            return f"it did not get up within {SECONDS:g} s, in {self.tries} of {TRIES} tries"
        if not lying:
            return None
        if self.tries == TRIES:
            return f"{TRIES} tries to get up have failed"
        if self._tick - self._lay < (BRACE_SECONDS + RESTLESS_SECONDS) * rate:
            return None
        return f"it does not lie still for {STILL_SECONDS:g} s: is it held, or does it hang?"
