"""The body that a virtual rig's motors move: the simulated backend's model, driven by voltages and read by encoders.

The motor is the actuator of `sim/model.py`. Its controller makes a voltage of `gain * (control - angle)`; here the
gain is one volt a radian and the control is `angle + voltage`, so that firmware of any operating mode can drive the
very same motor: in position mode with a P gain alone, the torque is that of the simulated backend to the last bit but
rounding.
"""

from __future__ import annotations

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Scene, Start
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.hw.seeds import Stream, generator
from servoid.sim.ground import Ground
from servoid.sim.joints.friction import Friction
from servoid.sim.joints.loops import Loops
from servoid.sim.model import FLOOR, TIMESTEP, build
from servoid.sim.randomise import Body, draw
from servoid.sim.scene import robot_bodies, scene_sensors
from servoid.sim.truth import SimulatedTruth
from servoid.sim.worlds import NOISE_ROWS, VELOCITY_NOISE, with_errors

CLEARANCE = 0.05  # m between the soles and the floor while the robot is held
_HELD = 1e6  # kg and kg m2 that the base has beside its own while somebody holds it: it gives to no motion of a limb
_HELD_TOLERANCE = 1e-14  # of the solver, which would otherwise take the light limbs beside it for settled
_R, _K, _KP, _VMAX = 0, 1, 4, 7  # indices in a dcmotor's gainprm


class Plant:
    """One body and its sensors. Joint arrays are `(n_joints,)` in the robot's order.

    While it is `held`, somebody holds the base still above the floor and keeps joints without torque in their pose;
    joints with torque move. `release` puts it on its feet.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._legs = Legs(robot)
        self.furnish(None)

    def furnish(self, scene: Scene | None) -> None:
        """Put a scene around the robot, which is held at home again."""
        robot = self.robot
        self.model = build(robot, scene)
        self.data = mujoco.MjData(self.model)
        self._ground, self._loops = Ground(self.model), Loops(self.model, robot)
        self._bodies, self._scene = robot_bodies(self.model), scene_sensors(self.model)
        joints = [self.model.joint(name) for name in robot.names]
        self._qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self._dof = np.array([int(joint.dofadr[0]) for joint in joints])
        self._nominal = {
            name: getattr(self.model, name).copy() for name in ("body_mass", "body_inertia", "geom_friction")
        }
        self.resistance = self.model.actuator_gainprm[:, _R].copy()  # Ohm, at the joint: V = R/K torque + K speed
        self.constant = self.model.actuator_gainprm[:, _K].copy()  # V s/rad
        self.model.actuator_gainprm[:, _KP] = self.constant / self.resistance
        self._friction = Friction(robot)
        self._armature, self._tolerance = self.model.dof_armature[:6].copy(), float(self.model.opt.tolerance)
        self._braking = np.array([servo.braking_torque for servo in robot.servos])
        self._slowest = np.array([servo.velocity_unit / 2 for servo in robot.servos])  # rad/s that are no count
        self._noise = np.zeros((NOISE_ROWS, 6 + len(joints)))
        self._recent = np.zeros((max(round(robot.dt / TIMESTEP), 1), self.model.nsensordata))  # of the last tick
        views = (view[None] for view in (self.data.qpos, self.data.qvel, self.data.sensordata, self._recent))
        self.truth = SimulatedTruth(self.model, robot, *views)
        self.reset(0)

    def reset(self, seed: int, *, randomise: bool = False) -> None:
        """Hold the robot at home, every draw from the stream of this seed.

        The stream is that of the simulated backend, used as its worlds use it: the same seed is the same robot with
        the same noise.
        """
        self._rng = generator(seed, Stream.BODY)
        randomise = self._rng.random() < float(randomise)
        self.body: Body = draw(self._rng, self.robot, self._bodies, randomise)
        self.stiffness = self.body.stiffness / self.robot.servos[0].stiffness  # factor on every servo's
        own = slice(self._bodies)
        self.model.body_mass[own] = self._nominal["body_mass"][own] * self.body.mass
        self.model.body_inertia[own] = self._nominal["body_inertia"][own] * self.body.mass[:, None]
        self.model.geom_friction[:] = self._nominal["geom_friction"]
        self.model.geom_friction[self.model.geom(FLOOR).id, 0] = self.body.friction
        self.model.dof_armature[:6] = self._armature
        mujoco.mj_setConst(self.model, self.data)
        mujoco.mj_resetData(self.model, self.data)
        self.held, self._noise_block, self._ticks = True, -1, 0
        self.laid: Start | None = None  # how it is held and let go; None: on its feet
        self._idle_rng = generator(seed, Stream.BODY, 1)  # while held: the episode's stream waits
        self._idle = self._idle_rng.standard_normal(6 + len(self.robot.joints))
        first = self.robot.servos[0]
        later = np.array([servo.position_latency - first.position_latency for servo in self.robot.servos])
        ages = np.round(np.maximum(self.body.joint_latency + later, 0.0) / TIMESTEP).astype(int)
        self._joint_age = int(ages.max())
        self._sample = self._joint_age - ages, np.arange(len(ages))  # of each joint in its history
        self._imu_age = max(round(self.body.imu_latency / TIMESTEP) - 1, 0)  # sensor data is a substep old already
        self._imu_span = max(round(self.robot.imu.average / TIMESTEP), 1)
        self.place(self.robot.home)

    def place(self, pose: Array) -> None:
        """Move the joints to `pose` as by hand, and hold the robot there, still and with its history still."""
        data = self.data
        data.qvel[:] = 0.0
        data.qpos[self._qpos] = pose - self.body.zero
        self._loops.close(data.qpos)
        data.qpos[0:2] = 0.0
        data.qpos[2], data.qpos[3:7] = self._stance()
        data.qpos[2] += CLEARANCE
        self.held = True
        self._play = data.qpos[self._qpos].copy()
        self._force = np.zeros((self._joint_age + 1, self.model.nu))
        self._angle = np.repeat(self._play[None], self._joint_age + 1, 0)
        self._speed = np.zeros_like(self._angle)
        self._forward()
        gravity = -self.truth.gravity[0] * -self.model.opt.gravity[2]
        self._imu = np.repeat(np.concatenate([np.zeros(3), gravity])[None], self._imu_age + self._imu_span, 0)

    def release(self) -> None:
        """Put the held robot on its feet where it is, and let go."""
        if self.held:
            self.data.qpos[2], self.data.qpos[3:7] = self._stance()
            self.data.qvel[0:6] = 0.0
            if self.laid is not None:
                if self.laid.position is not None:
                    self.data.qpos[2] = self.laid.position[0, 2]
                if self.laid.angular_velocity is not None:
                    self.data.qvel[3:6] = self.laid.angular_velocity[0]
            self.held, self._ticks = False, 0
            self._forward()

    def _stance(self) -> tuple[float, Array]:
        """Height [m] and orientation `(4,)` in which the held robot touches the ground: on its feet, or as it is laid
        down."""
        if self.laid is None or self.laid.orientation is None:
            height, orientation = self._legs.stand(self.data.qpos[self._qpos])
            return float(height), orientation
        qpos = self.data.qpos.copy()
        qpos[3:7] = self.laid.orientation[0]
        return self._ground.height(qpos), qpos[3:7]

    def _forward(self) -> None:
        """Sense the body where it was put."""
        mujoco.mj_forward(self.model, self.data)
        self._recent[:] = self.data.sensordata

    def step(self, volts: Array, powered: Array, supply: float) -> None:
        """Advance by one `TIMESTEP` with `volts` across the windings of `powered` servos; the rest turn freely."""
        data, model = self.data, self.model
        limit = np.where(powered, self._braking, 0.0)
        model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1] = -limit, limit
        model.actuator_gainprm[:, _VMAX] = supply
        data.ctrl[:] = data.qpos[self._qpos] + volts
        if self._friction.varies:
            model.dof_frictionloss[self._dof] = self._friction.at(data.qvel[self._dof], data.actuator_force)
        model.dof_armature[:6] = _HELD if self.held else self._armature
        model.opt.tolerance = _HELD_TOLERANCE if self.held else self._tolerance
        if not self.held:
            mujoco.mj_step(model, data)
            self._ticks += 1
        else:
            base, still = data.qpos[:7].copy(), data.qpos[self._qpos].copy()
            mujoco.mj_step(model, data)
            data.qpos[:7], data.qvel[:6] = base, 0.0
            data.qpos[self._qpos] = np.where(powered, data.qpos[self._qpos], still)
            data.qvel[self._dof] = np.where(powered, data.qvel[self._dof], 0.0)
            self._idle_rng.standard_normal(out=self._idle)
        q = data.qpos[self._qpos]
        half = self.body.backlash / 2
        self._play = np.clip(self._play, q - half, q + half)
        _push(self._angle, self._play)
        _push(self._speed, data.qvel[self._dof])
        _push(self._force, data.actuator_force)
        _push(self._recent, data.sensordata)
        if not self.held:
            _push(self._imu, data.sensordata[:6])

    def push(self, velocity: Array) -> None:
        """Change the base's velocity by `(2,)` m/s, world frame."""
        self.data.qvel[0:2] += velocity

    def move(self, places: Array) -> None:
        """Put the centres of the scene's spheres to `(m, 3)` m."""
        self.data.mocap_pos[:] = places

    @property
    def joints(self) -> Array:
        """True joint angles as an ideal encoder would show them, mounted as this robot's are [rad]."""
        return self.data.qpos[self._qpos] + self.body.zero

    @property
    def touches(self) -> Array:
        """Contacts of the scene's sensors within the last tick `(n,)`."""
        return self._recent[:, self._scene].max(0)

    @property
    def joint_speed(self) -> Array:
        """True joint speeds [rad/s]."""
        return self.data.qvel[self._dof]

    @property
    def torque(self) -> Array:
        """True torque of the motors [N m]."""
        return self._force[-1]

    @property
    def encoder(self) -> tuple[Array, Array, Array]:
        """What the servos have measured by now: angle [rad], speed [rad/s] with noise, torque [N m]. A servo that rests
        measures no speed at all: its encoder shows the same tick again and again."""
        speed = self._speed[self._sample]
        moving = np.abs(speed) > self._slowest
        measured = np.where(moving, speed + VELOCITY_NOISE * self._row()[6:], 0.0)
        return self._angle[self._sample] + self.body.zero, measured, self._force[self._sample]

    @property
    def imu(self) -> Array:
        """Angular velocity [rad/s] and specific force [m/s2] `(6,)` in the base frame, with the board's errors."""
        mean, body = self._imu[: self._imu_span].mean(0), self.body
        errors = self.robot.imu, body.imu_tilt, body.gyro_bias, body.accelerometer_bias
        return np.concatenate(with_errors(mean, self._row(), *errors))

    def _row(self) -> Array:
        """Standard normal noise `(6 + n_joints,)` of this control tick: a second read within it gives the same."""
        if self.held:
            return self._idle
        tick = int(self._ticks * TIMESTEP / self.robot.dt + 1e-6)
        block, row = divmod(tick, NOISE_ROWS)
        if block != self._noise_block:
            self._rng.standard_normal(out=self._noise)
            self._noise_block = block
        return self._noise[row]


def _push(history: Array, newest: Array) -> None:
    history[:-1] = history[1:]
    history[-1] = newest
