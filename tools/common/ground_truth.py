"""The truth of a simulated run, tick by tick, in the frame that the robot's odometry started in.

With other robots it is the frame of the scene, in which their goals are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace
from servoid.hw.geometry import headed, turned, up_vector
from servoid.hw.robot.description import Robot
from servoid.sim.ground import Ground
from servoid.sim.joints.loops import Loops
from servoid.sim.model import build
from servoid.sim.truth import FALL_HEIGHT, FALL_TILT
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.phase import Phase
from servoid.tools.common.motion_quality import Poses


class Falls:
    """Counts falls of a robot that gets up again."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._before = Phase.LIMP
        self._rose: int | None = None  # tick at which the first try since the fall began
        self._up = 0  # the last tick at which it did not stand
        self.falls = 0
        self.seconds: list[float] = []  # from lying still to standing, of each time that it got up

    def watch(self, record: TickRecord, standing: bool) -> None:
        """`standing`: whether the robot stands at this tick."""
        before, phase, self._before = self._before, record.phase, record.phase
        if phase is Phase.FALLEN and before in {Phase.READY, Phase.RUNNING}:
            self.falls, self._rose = self.falls + 1, None
        if phase is Phase.RECOVERING and self._rose is None:
            self._rose = record.tick
        if phase is Phase.RUNNING and before is Phase.RECOVERING and self._rose is not None:
            self.seconds.append((self._up + 1 - self._rose) * self._dt)
        if not standing:
            self._up = record.tick


@dataclass(frozen=True)
class FirstFall:
    """How a robot was when it had just fallen."""

    position: Array  # (3,) m, of the base in the world
    orientation: Array  # (4,) w x y z
    joints: Array  # (n_joints,) rad

    def cause(self, robot: Robot) -> str:
        """What makes it a fall: `tilted`, `on the ground with` bodies of the MJCF that are not of a foot, `low`, or
        `as the guard saw it`, where the guard alone took it for one."""
        if up_vector(self.orientation)[2] < math.cos(FALL_TILT):
            return "tilted"
        model = build(robot)
        qpos = model.qpos0.copy()
        qpos[:3], qpos[3:7] = self.position, self.orientation
        qpos[[int(model.joint(name).qposadr[0]) for name in robot.names]] = self.joints
        Loops(model, robot).close(qpos)
        names = Ground(model).touched_by(qpos, [foot.geoms[0] for foot in robot.feet.values()])
        if names:
            return f"on the ground with {', '.join(names)}"
        return "low" if self.position[2] < FALL_HEIGHT * robot.standing_height else "as the guard saw it"


class GroundTruth:
    """An `on_tick` listener: one row for each tick of the task.

    In a world of several robots it follows the first; that any of them fell or touched another counts. `fell_ending`:
    whether it fell after the task, while it came to rest, was lowered or went limp on a seat. Of a run that may
    `recover` the trace says of a fall whether the robot is down at the end.
    """

    def __init__(
        self, simulation: Simulation, dt: float, *, recover: bool = False, low: bool = False, seated: bool = False
    ) -> None:
        self._truth, self._surroundings, self._dt = simulation.truth, simulation.surroundings, dt
        self._rows: list[tuple[Array, float, Array, float, Array]] = []
        self._joints: list[Array] = []
        self._up: list[Array] = []
        self._obstacles: list[Array] = []
        self._robots: list[Array] = []
        self._objects: list[Array] = []
        self._low, self._seated = low, seated
        self._orientation: list[Array] = []
        self._fallen = self._touched = self.fell_ending = False
        self._ever = False  # whether it has fallen
        self.down: FirstFall | None = None  # as it was when it first fell, if it did
        self.falls = Falls(dt) if recover else None
        self.upright = 0  # ticks of the task before the robot had fallen

    def __call__(self, record: TickRecord) -> None:
        instruction, truth = record.proposal.instruction, self._truth
        if self.falls is not None:
            self.falls.watch(record, not self._down[0])
        if instruction is None:
            if self._rows and not self._fallen:
                self.fell_ending |= record.phase in (Phase.STOPPING, Phase.LOWERING) and bool(self._down[0])
                self.fell_ending |= self._seated and record.phase is Phase.DAMPED and bool(self._tilted[0])
                self.fell_ending |= any(event.kind == "fall" for event in record.events)
                self._keep_first(self.fell_ending)
            return
        fallen = bool(self._down.any())
        self._keep_first(fallen)
        self._ever |= fallen
        self._fallen = self._ever if self.falls is None else fallen
        self.upright += not self._ever
        self._joints.append(truth.joints[0].copy())
        self._up.append(-truth.gravity[0])
        self._orientation.append(truth.orientation[0].copy())
        if self._surroundings is not None:
            self._touched |= bool(truth.touching.any())
            self._obstacles.append(self._surroundings.obstacles)
            self._objects.append(truth.objects[0])
            self._robots.append(np.column_stack([truth.position[1:, :2], truth.yaw[1:]]))
        rate = -float(truth.gravity[0] @ truth.angular_velocity[0])
        self._rows.append(
            (truth.position[0].copy(), float(truth.yaw[0]), truth.velocity[0], rate, instruction.velocity)
        )

    def _keep_first(self, fell: bool) -> None:
        """Keep how the robot is, or the first of several that is down, if it fell and had not fallen before."""
        if fell and self.down is None:
            truth, i = self._truth, int(np.argmax(self._down))
            self.down = FirstFall(truth.position[i].copy(), truth.orientation[i].copy(), truth.joints[i].copy())

    @property
    def _down(self) -> Array:
        """Whether each robot has fallen; one that may be `low` by its tilt alone, one that may be `seated` also where
        anything but its feet touches the ground."""
        if not (self._low or self._seated):
            return self._truth.fallen
        return self._tilted if self._low else self._tilted | self._truth.grounded

    @property
    def _tilted(self) -> Array:
        return np.asarray(-self._truth.gravity[:, 2] < math.cos(FALL_TILT))

    def trace(self) -> Trace:
        """The run by the truth; without rows if the guard never let the task begin."""
        if not self._rows:
            none = np.zeros((0, 3))
            return Trace(self._dt, none, np.zeros(0), none, np.zeros(0), none, self._fallen)
        position, yaw, velocity, rate, command = (np.array(column) for column in zip(*self._rows, strict=True))
        yaw, (origin, heading) = np.unwrap(yaw), self._frame()
        goal = None if self._surroundings is None else self._surroundings.scene.goal
        if goal is not None:  # where it lies, which is where the robot sees it
            goal = np.tile(turned(np.array([*goal, 0.0]) - origin, -heading)[:2], (len(yaw), 1))
        return Trace(
            dt=self._dt,
            displacement=turned(position - origin, -heading),
            yaw=yaw - heading,
            velocity=velocity,
            yaw_rate=rate,
            command=command,
            fallen=self._fallen,
            joints=np.array(self._joints),
            orientation=headed(np.array(self._orientation), np.full(len(yaw), -heading)),
            goal=goal,
            obstacles=turned(np.array(self._obstacles) - origin, -heading) if self._obstacles else None,
            robots=turned(np.array(self._robots) - [*origin[:2], heading], -heading) if self._others() else None,
            objects=self._seen_objects(origin, heading),
            touched=self._touched if self._obstacles else None,
        )

    def _seen_objects(self, origin: Array, heading: float) -> Array | None:
        if not self._objects or not len(self._objects[0]):
            return None
        poses = np.array(self._objects)
        turn = np.full(poses.shape[:2], -heading)
        return np.concatenate([turned(poses[..., :3] - origin, -heading), headed(poses[..., 3:], turn)], -1)

    def _others(self) -> bool:
        return bool(self._robots) and len(self._robots[0]) > 0

    def _frame(self) -> tuple[Array, float]:
        """Origin `(3,)` m of the trace's frame in the world, and its heading [rad]."""
        return (np.zeros(3), 0.0) if self._others() else self._start()

    def _start(self) -> tuple[Array, float]:
        """The place on the ground `(3,)` m where the task began, and the heading there [rad]."""
        return self._rows[0][0] * [1.0, 1.0, 0.0], self._rows[0][1]

    def poses(self) -> Poses:
        """All poses before the robot had fallen."""
        upright = slice(self.upright)
        position, yaw, *_ = zip(*self._rows, strict=True) if self._rows else ((), ())
        return Poses(
            self._dt,
            np.array(position[upright]).reshape(-1, 3),
            np.array(yaw[upright], dtype=float),
            np.array(self._up[upright]).reshape(-1, 3),
            np.array(self._joints[upright]),
        )

    def odometry_error(self, estimate: Trace) -> float:
        """Distance [m] between where the robot ended and where it believed to be; NaN if the task never began."""
        if not self._rows:
            return float("nan")
        origin, heading = self._start()
        end = turned(self._rows[-1][0] - origin, -heading)[:2]
        return float(np.linalg.norm(end - estimate.displacement[-1, :2]))
