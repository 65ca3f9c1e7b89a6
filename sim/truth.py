"""The simulation's own state. Rewards and evaluation read it; no policy, estimator or task ever sees it."""

from __future__ import annotations

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import turned, up_vector, yaw_of
from servoid.hw.robot.description import Robot
from servoid.sim.multi_robot import ADDED
from servoid.sim.objects import ObjectsOf
from servoid.sim.scene import OBJECTS, scene_sensors

FALL_HEIGHT = 0.6  # of the standing height
FALL_TILT = np.deg2rad(60.0)


class SimulatedTruth:
    """Live views of the worlds' truth. All arrays are `(n, ...)`, world frame unless said otherwise."""

    def __init__(
        self, model: mujoco.MjModel, robot: Robot, qpos: Array, qvel: Array, sensors: Array, recent: Array | None = None
    ) -> None:
        """`recent` `(n, substeps, ...)` are the sensors at the substeps of the last tick; by default those of now."""
        self._robot, self._qpos, self._qvel, self._sensors = robot, qpos, qvel, sensors
        self._recent = sensors[:, None] if recent is None else recent
        views = [model.sensor(i) for i in range(model.nsensor)]
        starts = {sensor.name.removeprefix(ADDED): (int(sensor.adr[0]), int(sensor.dim[0])) for sensor in views}
        self._at = {name: slice(start, start + size) for name, (start, size) in starts.items()}
        self._scene = scene_sensors(model)
        self._objects = ObjectsOf(model, OBJECTS)
        joints = [model.joint(name) for name in robot.names]
        self._joint_qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self._joint_dof = np.array([int(joint.dofadr[0]) for joint in joints])

    def _feet(self, what: str) -> Array:
        return np.stack([self._sensors[:, self._at[f"{foot}_{what}"]] for foot in self._robot.feet], 1)

    @property
    def qpos(self) -> Array:
        """MuJoCo's generalised positions `(n, nq)`."""
        return self._qpos

    @property
    def position(self) -> Array:
        """Base position `(n, 3)` m."""
        return self._qpos[:, 0:3]

    @property
    def orientation(self) -> Array:
        """Base quaternion `(n, 4)` w x y z."""
        return self._qpos[:, 3:7]

    @property
    def yaw(self) -> Array:
        """Heading `(n,)` rad in -pi..pi."""
        return yaw_of(self.orientation)

    @property
    def gravity(self) -> Array:
        """Unit vector along gravity in the base frame `(n, 3)`."""
        return -up_vector(self.orientation)

    @property
    def tilt(self) -> Array:
        """Angle of the base from upright `(n,)` rad."""
        return np.arccos(np.clip(-self.gravity[:, 2], -1.0, 1.0))

    @property
    def velocity(self) -> Array:
        """Base velocity `(n, 3)` m/s in the heading frame."""
        return turned(self._qvel[:, 0:3], -self.yaw)

    @property
    def angular_velocity(self) -> Array:
        """Base angular velocity `(n, 3)` rad/s in the base frame."""
        return self._qvel[:, 3:6]

    @property
    def joints(self) -> Array:
        """Joint positions `(n, n_joints)` rad."""
        return self._qpos[:, self._joint_qpos]

    @property
    def joint_velocity(self) -> Array:
        """Joint velocities `(n, n_joints)` rad/s."""
        return self._qvel[:, self._joint_dof]

    @property
    def foot_force(self) -> Array:
        """Normal force of the ground on each foot `(n, n_feet)` N."""
        return np.abs(self._feet("contact")[..., 3])

    @property
    def foot_position(self) -> Array:
        """Centres of the soles `(n, n_feet, 3)` m."""
        return self._feet("position")

    @property
    def foot_velocity(self) -> Array:
        """Velocities of the soles' centres `(n, n_feet, 3)` m/s."""
        return self._feet("velocity")

    @property
    def foot_up(self) -> Array:
        """Upward axes of the soles `(n, n_feet, 3)`."""
        return self._feet("up")

    @property
    def shock(self) -> Array:
        """The greatest specific force on the base within the last tick `(n,)` m/s2: 9.8 at rest."""
        return np.linalg.norm(self._recent[:, :, 3:6], axis=-1).max(-1)

    @property
    def fallen(self) -> Array:
        """Whether each body has fallen `(n,)`: too low, too tilted, or on the ground with anything but its feet."""
        low = self.position[:, 2] < FALL_HEIGHT * self._robot.standing_height
        return low | (self.tilt > FALL_TILT) | self.grounded

    @property
    def grounded(self) -> Array:
        """Whether each body touches the ground with anything but its feet `(n,)`."""
        all_contacts = self._sensors[:, self._at["floor"]][:, 0]
        return np.asarray(all_contacts > self._feet("contact")[..., 0].sum(-1))

    @property
    def objects(self) -> Array:
        """The scene's objects as they are `(n, objects, 7)`: x, y, z m of the middle, quaternion w x y z."""
        return self._objects.poses(self._qpos)

    @property
    def object_velocity(self) -> Array:
        """Velocities of the movable objects `(n, movable objects, 3)` m/s, world frame."""
        return self._qvel[:, self._objects.qvel[:, :3]]

    @property
    def touching(self) -> Array:
        """Whether each body touches an obstacle of the scene, or another robot, or did within the last tick `(n,)`."""
        return np.any(self._recent[:, :, self._scene] > 0, axis=(1, 2))
