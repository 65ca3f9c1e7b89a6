"""What a controller knows, is asked, and answers: state, instruction, reference, policy and plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from servoid.hw.contracts.body import Array


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
class ReferenceFrames:
    """`k` frames of a motion to track, along the axis before the last; of a number a frame, along the last.

    A velocity is in the heading frame of its own frame. The root's pose is in the heading frame of the reference's
    own root now: x along its heading at `ahead` 0, z up, and the origin on the ground below it. So a clip is tracked
    wherever the robot is, by its displacement from now on; nothing says where it was recorded.
    """

    position: Array  # (..., k, n_joints) rad
    joint_velocity: Array  # (..., k, n_joints) rad/s
    velocity: Array  # (..., k, 2) m/s of the base, heading frame of the same frame
    yaw_rate: Array  # (..., k) rad/s about the vertical
    height: Array  # (..., k) m of the base above the ground
    root_position: Array  # (..., k, 3) m of the base, present heading frame of the reference; z is `height`
    root_orientation: Array  # (..., k, 4) quaternion w x y z, base in the same frame; of no yaw at `ahead` 0
    contact: Array  # (..., k, n_feet) 0..1, planned


class Reference(Protocol):
    """A motion that a tracker follows: a gait, a clip, or a planner's output; of one robot or of many worlds `...`."""

    @property
    def ended(self) -> Array:
        """Whether the motion is over `(...)`: its last frame then holds, at rest. A gait and a loop never end."""
        ...

    def reset(self, where: Array | slice = slice(None)) -> None:
        """Begin anew in the worlds `where` (default: all)."""
        ...

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
class DistanceMap:
    """How far it is to the goal by a free way, on a grid."""

    corner: Array  # (2,) m in the heading frame: where the grid begins
    yaw: float  # rad, of the grid's first axis in the heading frame
    size: float  # m, from one point of the grid to the next
    metres: Array  # (n, m) at its points; more than the way is long beside obstacles, and much more inside them


@dataclass(frozen=True, slots=True)
class Instruction:
    """What a task asks of a policy at a tick."""

    velocity: Array  # (..., 3) m/s forward, m/s left, rad/s: base, heading frame
    goal: Array | None = None  # (..., 2) m in the heading frame, from the base
    text: str | None = None  # a sentence that says what to do; None: go by the velocity; empty: by neither
    texts: tuple[str, ...] | None = None  # one for each world, instead of `text`
    since: Array | None = None  # (...,) s since the skill began that `text` tells, or a walk's clock; None: 0
    path: Array | None = None  # (n, 2) m in the heading frame: where to be at the next n ticks
    obstacles: Array | None = None  # (n, 5) in the heading frame: x, y, radius m, velocity m/s; to be kept clear of
    keyframes: Keyframes | None = None
    ground: Array | None = None  # (2,) m/s over the ground in the heading frame, where the task asks for one
    distances: DistanceMap | None = None  # to the goal by a free way, where the task works that out
    skill: str | None = None  # name of a skill, for as long as that is asked for; None: stand, or walk
    stand: bool = False  # come to rest, and stand: that is all a planner's cost is about, whatever the task wants
    # Where parts of the body shall be at the end of a plan, by name: m in the heading frame from below the base, a
    # point of the ground being (2,), others (3,); "heading": rad.
    targets: Mapping[str, Array] | None = None
    # Bars to pass under (n, 5): x, y m of the middle in the heading frame, rad of its direction there, half its length
    # and the height of its lower edge above the ground, m.
    bars: Array | None = None
    # A thing to be carried to `goal` (..., 7): x, y, z m of its middle in the heading frame from below the base, and
    # its quaternion there.
    box: Array | None = None
    lower: Array | None = None  # (...) m that a gait shall go lower than it does; None: not at all


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What a planner is asked at `tick`: the newest `history` of features and the actions that run meanwhile.

    All that the plan depends on is in it: a plan draws its noise from the episode's seed and age.
    """

    tick: int
    states: Array  # (..., history, state features), oldest first, the last one being now
    actions: Array  # (..., history - 1 + delay, action size) of past states' ticks, then those yet to run; as in a Plan
    instruction: Instruction
    previous: Plan | None = None  # the plan that runs, for planners that go on from it
    seeds: Array = field(default_factory=lambda: np.zeros((), int))  # (...,) int of the episodes
    ages: Array | None = None  # (...,) int, ticks that the episodes have lasted; None: `tick`


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan indexed by tick: `actions[i]` belongs to tick `tick + i`.

    Actions are joint targets [rad] or, where the planner's model has them, latents, which whoever runs the plan decodes
    with the state of their own tick.
    """

    tick: int
    actions: Array  # (..., horizon, action size), action size: n_joints, or that of a latent
    states: Array  # (..., horizon, state features)
    path: Array  # (..., horizon, 2) m: predicted displacement in the heading frame of `tick`, to be drawn and logged
    seconds: float  # how long planning took
    error: str = ""  # why there is no plan, where there is none: its arrays are NaN then
    ticks: Array | None = None  # (horizon,) int, of states and path, ahead of `tick`; None: 1, 2, ...


@dataclass(frozen=True, slots=True)
class Adopted:
    """A plan at the tick of its adoption; ticks count calls of the policy in this run."""

    requested: int
    adopted: int
    plan: Plan


class Policy(Protocol):
    """A controller. `stack.control.base.BasePolicy` answers all but `act` for one that neither plans nor holds
    anything."""

    def reset(self, where: Array | None, seeds: Array) -> None:
        """Begin an episode in the worlds `where` `(...,)` bool, None being all; one robot is a world of shape `()`.

        Their random numbers all come from `seeds` `(...,)` int.
        """
        ...

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(..., n_joints)` rad for the next tick. `applied` is what the guard really sent last, so that
        a policy never believes its own wishes. Whatever it raises ends the run safely."""
        ...

    @property
    def adopted(self) -> Adopted | None:
        """The plan that was taken over in the last call of `act`; None where that took over none."""
        ...

    def take_events(self) -> tuple[str, ...]:
        """What a person should know of, since the last call."""
        ...

    def repeat(self, plans: Mapping[int, int]) -> None:
        """Take over the plans of a recorded run and no others: ticks of their requests, and of their adoption."""
        ...

    def close(self) -> None:
        """Let go of processes and devices."""
        ...
