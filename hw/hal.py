"""The contracts of the hardware abstraction layer.

Every body (simulated, virtual or real) is read as an `Observation` and driven by a `Command`; everything above
works on the `State` that the estimator makes of observations. Arrays follow the robot's joint order and may carry
leading world dimensions: `(..., n_joints)`. A value that was not read is NaN, never zero and never invented.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class Mode(IntEnum):
    """What a motor does with a command."""

    OFF = 0  # torque off: the joint is free
    DAMP = 1  # gains at zero with torque on: the motor brakes
    ACTIVE = 2  # track the position target


@dataclass(frozen=True, slots=True)
class Observation:
    """One read of a body.

    `fault` holds the bits of the servos' hardware-error register (0: none). `age` is the time since a joint's sample
    was taken, infinite if it never was.
    """

    time_ns: int  # monotonic
    position: Array  # (..., n_joints) rad
    velocity: Array  # (..., n_joints) rad/s
    effort: Array  # (..., n_joints) N m
    temperature: Array  # (..., n_joints) degrees C
    voltage: Array  # (..., n_joints) V
    age: Array  # (..., n_joints) s
    fault: Array  # (..., n_joints) int
    orientation: Array  # (..., 4) quaternion w x y z of the IMU's own fusion
    angular_velocity: Array  # (..., 3) rad/s, base frame
    specific_force: Array  # (..., 3) m/s2, base frame: +9.81 on z when level and still
    imu_age: Array  # (...,) s


@dataclass(frozen=True, slots=True)
class Command:
    """PD targets. `gain` scales the firmware's position gain (1: as configured); it is not in N m/rad."""

    position: Array  # (..., n_joints) rad
    gain: Array  # (..., n_joints)
    mode: Mode


@dataclass(frozen=True, slots=True)
class State:
    """What a policy may know, made by the estimator from observations alone.

    The odometry frame has its origin under the base and its x axis along the heading at reset; z is up and zero on
    the ground. The heading frame is the base frame turned upright.
    """

    time_ns: int
    orientation: Array  # (..., 4) quaternion w x y z, base in the odometry frame
    gravity: Array  # (..., 3) unit vector along gravity, base frame
    yaw: Array  # (...,) rad, heading in the odometry frame, unwrapped
    angular_velocity: Array  # (..., 3) rad/s, base frame
    velocity: Array  # (..., 3) m/s of the base, heading frame
    displacement: Array  # (..., 3) m, base in the odometry frame; z is the height above the soles
    position: Array  # (..., n_joints) rad
    joint_velocity: Array  # (..., n_joints) rad/s
    contact: Array  # (..., n_feet) 0..1, how much a foot carries


@dataclass(frozen=True, slots=True)
class Percept:
    """What else a task may know, in the odometry frame, with its age and where it came from.

    `robots` are the others that share the floor, as a camera sees them: where their bases are and where they face. How
    fast they go, a task tells from where they were before.
    """

    source: str  # "task", "scene", or the name of an external feed
    age: float  # s
    goal: Array | None = None  # (2,) m
    obstacles: Array | None = None  # (n, 3) m: x, y, radius
    robots: Array | None = None  # (n, 3): x, y m and heading rad


@dataclass(frozen=True, slots=True)
class Scene:
    """What a task puts into a simulated world, on its floor, in the frame that the robot starts in: x ahead.

    In a percept, obstacles are the pillars followed by the spheres.
    """

    pillars: Array  # (n, 3) m: x, y, radius; they stand where they are
    spheres: Array  # (m, 4): x, y, radius m and speed m/s; they roll straight toward the robot
    goal: Array | None = None  # (2,) m, a mark on the floor that the robot sees
    robots: Array | None = None  # (n, 5): where the other robots start, x, y m and heading rad, and their goals, x, y m


class Surroundings(Protocol):
    """The scene of a simulated world as a camera on the robot shows it, without what lies outside the scene."""

    def look(self, state: State) -> Percept:
        """What is around the base, in the odometry frame of `state`. At each call, what moves goes on by a tick."""
        ...


class Sensors(Protocol):
    """The reading half of a backend."""

    def read(self) -> Observation:
        """Return the newest observation. Raises BackendError when the body cannot be reached."""
        ...


class Motors(Protocol):
    """The writing half of a backend. Only the guard holds one."""

    def write(self, command: Command) -> None:
        """Send a command. Raises BackendError when the body cannot be reached."""
        ...


class Clock(Protocol):
    """Monotonic time: the machine's, a simulation's, or a virtual rig's."""

    def now_ns(self) -> int: ...

    def sleep_until(self, time_ns: int) -> None:
        """Return at `time_ns`, or at once when it has passed."""
        ...


class Backend(Protocol):
    """A body: simulated, virtual or real. `connect` never moves it."""

    name: str
    clock: Clock

    def connect(self) -> tuple[Sensors, Motors]: ...

    def close(self) -> None:
        """Release the body. Motors are left with torque off."""
        ...


class BackendError(Exception):
    """A body cannot be reached or refused: exit code 3."""


class Truth(Protocol):
    """What a simulation knows of its bodies. Rewards and evaluation read it; policies, estimators and tasks never do.

    Arrays are `(n, ...)`, world frame unless said otherwise.
    """

    @property
    def position(self) -> Array:
        """Base position `(n, 3)` m."""
        ...

    @property
    def yaw(self) -> Array:
        """Heading `(n,)` rad in -pi..pi."""
        ...

    @property
    def gravity(self) -> Array:
        """Unit vector along gravity in the base frame `(n, 3)`."""
        ...

    @property
    def velocity(self) -> Array:
        """Base velocity `(n, 3)` m/s in the heading frame."""
        ...

    @property
    def angular_velocity(self) -> Array:
        """Base angular velocity `(n, 3)` rad/s in the base frame."""
        ...

    @property
    def fallen(self) -> Array:
        """Whether each body has fallen `(n,)`."""
        ...

    @property
    def joints(self) -> Array:
        """Joint positions `(n, n_joints)` rad."""
        ...

    @property
    def touching(self) -> Array:
        """Whether each body touches an obstacle of the scene, or another robot, or did within the last tick `(n,)`."""
        ...


class World(Protocol):
    """Many simulated bodies. An episode draws from its own random stream, so it does not depend on its neighbours."""

    n: int

    @property
    def truth(self) -> Truth: ...

    def reset(self, ids: Array, rngs: Sequence[np.random.Generator], joints: Array | None = None) -> None:
        """Start new episodes in the worlds `ids`, drawing their robots anew, at a pose `(len(ids), n_joints)` rad."""
        ...

    def observe(self) -> Observation: ...

    def step(self, command: Command) -> None: ...

    def push(self, velocity: Array) -> None:
        """Change the bases' velocity by `(n, 2)` m/s, world frame."""
        ...


@dataclass(frozen=True, slots=True)
class ReferenceFrames:
    """Frames of a motion to track, `k` of them along the axis before the last."""

    position: Array  # (..., k, n_joints) rad
    velocity: Array  # (..., k, 2) m/s of the base, heading frame
    yaw_rate: Array  # (..., k) rad/s
    height: Array  # (..., k) m of the base above the ground
    contact: Array  # (..., k, n_feet) 0..1, planned


class Reference(Protocol):
    """A motion that a tracker follows: a gait, a clip, or a planner's output."""

    def frames(self, ahead: Array) -> ReferenceFrames:
        """Frames `ahead` ticks from now, `(k,)` integers, 0 being the frame to be in at the next tick."""
        ...

    def advance(self) -> None:
        """Go on by one tick."""
        ...


@dataclass(frozen=True, slots=True)
class Keyframes:
    """States to be in at given times. A planner takes them as known: inpainted at zero noise."""

    ticks: Array  # (k,) int, ahead of now, at least 1 and rising
    states: Array  # (k, state features): rows like those of `PlanRequest.states`, in the odometry frame; NaN: free


@dataclass(frozen=True, slots=True)
class Instruction:
    """What a task asks of a policy at a tick."""

    velocity: Array  # (..., 3) m/s forward, m/s left, rad/s: base, heading frame
    goal: Array | None = None  # (..., 2) m in the heading frame, from the base
    text: str | None = None  # a sentence that says what to do; None: go by the velocity; empty: by neither
    path: Array | None = None  # (n, 2) m in the heading frame: where to be at the next n ticks
    obstacles: Array | None = None  # (n, 5) in the heading frame: x, y, radius m, velocity m/s; to be kept clear of
    keyframes: Keyframes | None = None
    ground: Array | None = None  # (2,) m/s over the ground in the heading frame, where the task asks for one


class Policy(Protocol):
    """A controller. `applied` is what the guard really sent last, so that a policy never believes its own wishes."""

    def reset(self, seed: int) -> None: ...

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(..., n_joints)` rad for the next tick."""
        ...


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What a planner is asked at `tick`: the newest `history` of features and the actions that run meanwhile."""

    tick: int
    states: Array  # (history, state features), oldest first, the last one being now
    actions: Array  # (history - 1 + delay, action size) of each past state's tick, then those yet to run; as in a Plan
    instruction: Instruction
    previous: Plan | None = None  # the plan that runs, for planners that go on from it


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan indexed by tick: `actions[i]` belongs to tick `tick + i`.

    Actions are joint targets [rad] or, where the planner's model has them, latents, which whoever runs the plan decodes
    with the state of their own tick.
    """

    tick: int
    actions: Array  # (horizon, action size), action size: n_joints, or that of a latent
    states: Array  # (horizon, state features)
    path: Array  # (horizon, 2) m: predicted displacement in the heading frame of `tick`, to be drawn and logged
    seconds: float  # how long planning took
    error: str = ""  # why there is no plan, where there is none: its arrays are NaN then


@dataclass(frozen=True, slots=True)
class Trace:
    """What a run went through, by the estimate or by the truth; one row a tick.

    The truth of a world of several robots says of any of them whether it fell or touched something.
    """

    dt: float
    displacement: Array  # (ticks, 3) m
    yaw: Array  # (ticks,) rad
    velocity: Array  # (ticks, 3) m/s, heading frame
    yaw_rate: Array  # (ticks,) rad/s
    command: Array  # (ticks, 3) instructed velocity
    fallen: bool
    joints: Array | None = None  # (ticks, n_joints) rad
    goal: Array | None = None  # (ticks, 2) m, where the robot saw it; None: where the task has it
    obstacles: Array | None = None  # (ticks, n, 3) m: x, y, radius
    robots: Array | None = None  # (ticks, n, 3) the others: x, y m and heading rad
    touched: bool | None = None  # whether the robot touched an obstacle or another robot; None: it cannot know


class Task(Protocol):
    """What the robot shall do. `success` is pure: `run` applies it to the estimate, evaluation to the truth."""

    name: str
    seconds: float

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode's goal, commands and disturbances."""
        ...

    def scene(self) -> Scene | None:
        """What a simulated world holds in this episode beside the robot; None for nothing."""
        ...

    def percept(self, state: State) -> Percept:
        """What the task itself tells the robot about its surroundings, where nobody sees them."""
        ...

    def disturbance(self, tick: int) -> Array | None:
        """Change of the base's planar velocity `(2,)` m/s, world frame, to be applied by a simulated body; or None."""
        ...

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction: ...

    def cost(self, trajectory: Any, instruction: Instruction) -> Any:
        """Guidance cost `(batch,)` of a predicted trajectory (torch), in the heading frame of now."""
        ...

    def done(self, state: State) -> bool: ...

    def success(self, trace: Trace) -> bool: ...

    def metrics(self, trace: Trace) -> dict[str, float]: ...
