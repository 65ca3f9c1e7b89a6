"""A simulated world: its bodies, what stands on its floor, what the robot sees of it, and its truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, Protocol

import numpy as np

from servoid.hw.contracts.body import Array, Command, Observation
from servoid.hw.contracts.control import State


@dataclass(frozen=True, slots=True)
class Percept:
    """What else a task may know, in the odometry frame, with its age and where it came from.

    `objects` are those of the scene, in its order. `robots` are the others that share the floor, as a camera sees them:
    where their bases are and where they face. How fast they go, a task tells from where they were before.
    """

    source: str  # "task", "scene", or the name of an external feed
    age: float  # s
    goal: Array | None = None  # (2,) m
    obstacles: Array | None = None  # (n, 3) m: x, y, radius
    robots: Array | None = None  # (n, 3): x, y m and heading rad
    objects: Array | None = None  # (n, 7): x, y, z m of the middle, quaternion w x y z


@dataclass(frozen=True, slots=True)
class SceneObject:
    """A thing with a body of its own: a ball that rolls, a bag that stands and falls and a box that hands can hold; or
    one that is fixed: a seat, a bar that lies across the way at a height, or a target, a ball in the air that nothing
    bumps into.

    Raises ValueError for a size or mass that no thing has.
    """

    kind: Literal["ball", "bag", "box", "seat", "bar", "target"]
    place: tuple[float, float]  # m, its middle, in the frame that the robot starts in
    size: tuple[float, float, float]  # m along its x, y and z; of a ball or target the first, its diameter
    mass: float = 0.0  # kg; of what is fixed it is not asked for
    heading: float = 0.0  # rad
    lift: float = 0.0  # m from the ground to its lowest point; of what is fixed alone

    def __post_init__(self) -> None:
        if min(self.size) <= 0.0:
            raise ValueError(f"size: must be positive, not {min(self.size):g}")
        if self.movable and self.mass <= 0.0:
            raise ValueError(f"mass: must be positive, not {self.mass:g}")
        if self.lift < 0.0 or (self.movable and self.lift):
            raise ValueError(f"lift: a {self.kind} cannot be {self.lift:g} m above the ground")

    @property
    def movable(self) -> bool:
        return self.kind in ("ball", "bag", "box")

    @property
    def round(self) -> bool:
        return self.kind in ("ball", "target")

    @property
    def height(self) -> float:
        """Of its middle, above the ground [m]."""
        return self.lift + (self.size[0] if self.round else self.size[2]) / 2


@dataclass(frozen=True, slots=True)
class Scene:
    """What a task puts into a simulated world, on its floor, in the frame that the robot starts in: x ahead.

    In a percept, obstacles are the pillars followed by the spheres. Objects may be touched, but for bars.
    """

    pillars: Array  # (n, 3) m: x, y, radius; they stand where they are
    spheres: Array  # (m, 4): x, y, radius m and speed m/s; they roll straight toward the robot
    goal: Array | None = None  # (2,) m, a mark on the floor that the robot sees
    robots: Array | None = None  # (n, 5): where the other robots start, x, y m and heading rad, and their goals, x, y m
    objects: tuple[SceneObject, ...] = ()


class Surroundings(Protocol):
    """A scene in play, as a camera on one of its robots shows it, without what lies outside the scene."""

    @property
    def scene(self) -> Scene:
        """The scene as it began."""
        ...

    @property
    def obstacles(self) -> Array:
        """Pillars and spheres as they are now `(n, 3)` m: x, y, radius, world frame. For evaluation alone."""
        ...

    def look(self, state: State) -> Percept:
        """What is around the base, in the odometry frame of `state`. At each call, what moves goes on by a tick."""
        ...


class Truth(Protocol):
    """What a simulation knows of its bodies. Rewards and evaluation read it; policies, estimators and tasks never do.

    Arrays are `(n, ...)`, world frame unless said otherwise.
    """

    @property
    def position(self) -> Array:
        """Base position `(n, 3)` m."""
        ...

    @property
    def orientation(self) -> Array:
        """Base quaternion `(n, 4)` w x y z."""
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
    def grounded(self) -> Array:
        """Whether each body touches the ground with anything but its feet `(n,)`."""
        ...

    @property
    def joints(self) -> Array:
        """Joint positions `(n, n_joints)` rad."""
        ...

    @property
    def objects(self) -> Array:
        """The scene's objects as they are `(n, objects, 7)`: x, y, z m of the middle, quaternion w x y z."""
        ...

    @property
    def touching(self) -> Array:
        """Whether each body touches an obstacle of the scene, or another robot, or did within the last tick `(n,)`."""
        ...


@dataclass(frozen=True, slots=True)
class Start:
    """How bodies begin an episode, a row for each: what is None is as of a robot that stands at its home pose, at rest.

    A body whose height is NaN is put down: so that it touches the ground with its lowest point, however it lies, or,
    without an `orientation`, stands flat on its first foot.
    """

    joints: Array | None = None  # (n, n_joints) rad
    position: Array | None = None  # (n, 3) m of the base, world frame; a height of NaN: put down
    orientation: Array | None = None  # (n, 4) unit quaternion w x y z, base in the world frame
    heading: Array | None = None  # (n,) rad by which that is turned about the vertical
    velocity: Array | None = None  # (n, 3) m/s of the base, world frame
    angular_velocity: Array | None = None  # (n, 3) rad/s, base frame
    joint_velocity: Array | None = None  # (n, n_joints) rad/s
    objects: Array | None = None  # (n, movable objects, 7) where they are, at rest; None: as the scene has them

    def of(self, ids: Array) -> Start:
        """The rows `ids` `(k,)`."""
        values = (getattr(self, field.name) for field in fields(self))
        return Start(*(None if value is None else value[ids] for value in values))


class World(Protocol):
    """Many simulated bodies. An episode draws from its own random stream, so it does not depend on its neighbours."""

    n: int

    @property
    def truth(self) -> Truth: ...

    def reset(self, ids: Array, rngs: Sequence[np.random.Generator], start: Start | None = None) -> None:
        """Begin new episodes in the worlds `ids`, drawing their robots anew; `start` has a row for each of them."""
        ...

    def observe(self) -> Observation: ...

    def step(self, command: Command) -> None: ...

    def put(self, ids: Array, objects: Array) -> None:
        """Put the movable objects of the worlds `ids` `(k,)` to poses `(k, movable objects, 7)`, at rest."""
        ...

    def push(self, velocity: Array) -> None:
        """Change the bases' velocity by `(n, 2)` m/s, world frame."""
        ...
