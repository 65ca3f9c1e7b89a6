"""Many simulated bodies of one robot, stepped by all cores: what training, collection and the simulated backend share.

A world's draws come from its own episode's random stream, so that an episode does not depend on its neighbours, on the
number of worlds or on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, Command, Mode, Observation
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import headed
from servoid.hw.robot.description import Imu, Robot
from servoid.hw.robot.legs import Legs
from servoid.sim.ground import Ground
from servoid.sim.joints.friction import Friction
from servoid.sim.joints.loops import Loops
from servoid.sim.model import FLOOR, TIMESTEP, build
from servoid.sim.multi_robot import Crowd
from servoid.sim.objects import ObjectsOf
from servoid.sim.randomise import Body, draw, longest
from servoid.sim.scene import OBJECTS, robot_bodies
from servoid.sim.truth import SimulatedTruth

NOISE_ROWS = 64  # ticks of sensor noise drawn at a time
VELOCITY_NOISE = 0.02  # rad/s, standard deviation, before quantisation
_GRAVITY = 9.81  # m/s2
_KP, _VMAX = 4, 7  # indices in a dcmotor's gainprm


class Worlds:
    """`n` bodies. Commands and observations are `(n, ...)`.

    `threads` 0 takes all cores; `randomise` is the share of episodes on a randomised robot. `together` puts all bodies
    into one world, whose `model` must hold them; its floor has the friction that was drawn with the last of them.
    `drawn` draws a robot, as `randomise.draw` does.
    """

    def __init__(
        self,
        robot: Robot,
        n: int,
        *,
        threads: int = 0,
        randomise: float = 0.0,
        model: mujoco.MjModel | None = None,
        together: bool = False,
        drawn: Callable[..., Body] = draw,
    ) -> None:
        self.robot, self.n, self.randomise, self._drawn = robot, n, randomise, drawn
        self.model = build(robot) if model is None else model
        self.substeps = round(robot.dt / TIMESTEP)
        if abs(self.substeps * TIMESTEP - robot.dt) > 1e-9:
            whole = round(1 / TIMESTEP)
            raise ConfigError(f"{robot.name}: rate: {robot.rate} does not divide the physics' {whole} steps a second")
        self.batch: Batch | Crowd = Crowd(self.model, n) if together else Batch(self.model, n, threads)
        self._legs, self._ground, self._loops = Legs(robot), Ground(self.model), Loops(self.model, robot)
        self._bodies, self._objects = robot_bodies(self.model), ObjectsOf(self.model, OBJECTS)
        joints = [self.model.joint(name) for name in robot.names]
        self._qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self._dof = np.array([int(joint.dofadr[0]) for joint in joints])
        servos = robot.servos
        self._unit = np.array([servo.current_unit * servo.torque_per_ampere for servo in servos])
        self._velocity_unit = np.array([servo.velocity_unit for servo in servos])
        self._tick_angle = robot.tick_angles
        self._nominal_voltage = np.array([servo.voltage for servo in servos])
        self._nominal_stiffness = np.array([servo.stiffness for servo in servos])
        self._braking = np.array([servo.braking_torque for servo in servos])
        self._voltage_unit = np.array([servo.voltage_unit for servo in servos])
        # What sets a servo apart from the first joint's, which is the one that a body is drawn for.
        self._volts = self._nominal_voltage / servos[0].voltage
        self._later = np.array([servo.command_delay - servos[0].command_delay for servo in servos])
        self._older = np.array([servo.position_latency - servos[0].position_latency for servo in servos])

        # Commands that may still be on their way, and samples that may still be on theirs.
        delay, latency = longest(robot)
        self._delayed = int(np.ceil(delay / robot.dt - 1e-6)) + 1
        self._imu_span = max(round(robot.imu.average / TIMESTEP), 1)
        span = max(2 * self.substeps, round(latency / TIMESTEP) + 1 + self._imu_span)

        b, nj = self.batch, len(robot.joints)
        self._state_qpos, self._state_qvel = b.bind("qpos"), b.bind("qvel")
        self._sensors = b.bind("sensordata")
        self._gain, self._force = b.expand("actuator_gainprm"), b.expand("actuator_forcerange")
        if self.model.nmocap:
            self._mocap = b.bind("mocap_pos")
        self._friction = Friction(robot)
        if self._friction.varies:
            self._loss = b.expand("dof_frictionloss")
        self._floor = b.expand("geom_friction")[:, self.model.geom(FLOOR).id]
        if randomise > 0:
            self._mass, self._inertia = b.expand("body_mass"), b.expand("body_inertia")
        self.bodies: list[Body | None] = [None] * n
        self._rngs: list[np.random.Generator] = [np.random.default_rng(0)] * n
        self._stiffness = np.zeros(n)
        self._supply = np.zeros((n, nj))
        self._delay, self._imu_age = np.zeros((n, nj)), np.zeros(n, int)
        self._joint_age = np.zeros((n, nj), int)
        self._zero, self._backlash = np.zeros((n, nj)), np.zeros((n, 1))
        self._gyro_bias, self._acc_bias, self._tilt = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 2))
        self._noise, self._noise_block = np.zeros((n, NOISE_ROWS, 6 + nj)), np.full(n, -1)
        self._commands = np.zeros((n, self._delayed, nj))  # oldest first
        self._play = np.zeros((n, nj))
        recorded = ("qpos", "qvel", "sensordata", "actuator_force")
        self._record = {key: np.zeros((n, span, b.bind(key).shape[1])) for key in recorded}
        self._fresh = {key: value[:, -self.substeps :].copy() for key, value in self._record.items()}
        self.ticks = np.zeros(n, int)  # since each world's reset
        self.tick = 0
        self.truth = SimulatedTruth(
            self.model, robot, self._state_qpos, self._state_qvel, self._sensors, self._fresh["sensordata"]
        )

    def reset(self, ids: Array, rngs: Sequence[np.random.Generator], start: Start | None = None) -> None:
        """Begin new episodes in the worlds `ids`, drawing new robots; `start` has a row for each of them.

        Sensors and motors have known the robot for long as it begins: the accelerometer reads gravity alone, so that an
        estimator finds its tilt, the gyro and the servos the velocities it begins with, and the joints' targets are
        where the joints are.
        """
        start = start or Start()
        shape = (len(ids), len(self.robot.joints))
        pose = np.broadcast_to(self.robot.home if start.joints is None else start.joints, shape)
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        for i, rng in zip(ids, rngs, strict=True):
            self._rngs[i] = rng
            self._place(i, self._drawn(rng, self.robot, self._bodies, rng.random() < self.randomise))
        self._state_qpos[ids] = 0.0
        objects = np.broadcast_to(self._objects.begin, (len(ids), *self._objects.begin.shape))
        self.put(ids, objects if start.objects is None else start.objects)
        self._state_qpos[ids[:, None], self._qpos] = pose - self._zero[ids]
        if self._loops.any:
            for i in ids:
                self._loops.close(self._state_qpos[i])
        self._put(ids, pose - self._zero[ids], start)
        self._state_qvel[ids] = 0.0
        for dofs, velocity in (
            (np.arange(0, 3), start.velocity),
            (np.arange(3, 6), start.angular_velocity),
            (self._dof, start.joint_velocity),
        ):
            if velocity is not None:
                self._state_qvel[ids[:, None], dofs] = velocity
        if self.randomise > 0:
            self.batch.set_const(ids)
        self._gain[ids, :, _KP], self._force[ids, :, 0], self._force[ids, :, 1] = 0.0, 0.0, 0.0
        self.batch.forward(ids)
        self._commands[ids] = pose[:, None]
        self._play[ids] = pose - self._zero[ids]
        for key, value in self._record.items():
            value[ids] = self.batch.bind(key)[ids][:, None]
        self._fresh["sensordata"][ids] = self._sensors[ids][:, None]
        self._record["sensordata"][ids, :, 0:3] = self.truth.angular_velocity[ids][:, None]
        self._record["sensordata"][ids, :, 3:6] = -_GRAVITY * self.truth.gravity[ids][:, None]
        self.ticks[ids], self._noise_block[ids] = 0, -1

    def _put(self, ids: Array, joints: Array, start: Start) -> None:
        """Place and turn the bases of bodies whose joints are there."""
        height, orientation = self._legs.stand(joints)
        if start.orientation is not None:
            orientation = start.orientation
        if start.heading is not None:
            orientation = headed(orientation, start.heading)
        self._state_qpos[ids, 3:7] = orientation
        position = np.full((len(ids), 3), [0.0, 0.0, np.nan]) if start.position is None else start.position
        self._state_qpos[ids, 0:3] = position
        down = np.isnan(position[:, 2])
        if start.orientation is not None and down.any():
            height = np.array([self._ground.height(self._state_qpos[i]) for i in ids])
        self._state_qpos[ids, 2] = np.where(down, height, position[:, 2])

    def _place(self, i: int, body: Body) -> None:
        self.bodies[i] = body
        self._stiffness[i], self._supply[i] = body.stiffness, body.voltage * self._volts
        self._delay[i] = np.maximum(body.command_delay + self._later, 0.0)
        self._joint_age[i] = np.round(np.maximum(body.joint_latency + self._older, 0.0) / TIMESTEP)
        self._imu_age[i] = max(round(body.imu_latency / TIMESTEP) - 1, 0)  # the recorded IMU is a substep old
        self._zero[i], self._backlash[i] = body.zero, body.backlash
        self._gyro_bias[i], self._acc_bias[i], self._tilt[i] = body.gyro_bias, body.accelerometer_bias, body.imu_tilt
        self._floor[i, 0] = body.friction
        if self.randomise > 0:
            own = slice(1, self._bodies)  # the world itself has no mass
            self._mass[i, own] = self.model.body_mass[own] * body.mass[own]
            self._inertia[i, own] = self.model.body_inertia[own] * body.mass[own, None]

    def step(self, command: Command, modes: Array | None = None) -> None:
        """Advance by one tick under `command`, whose arrays are `(n, n_joints)` or broadcast to it.

        `modes` `(n,)` are of `Mode`, where the bodies have other ones than the command.
        """
        self._commands[:, :-1] = self._commands[:, 1:]
        self._commands[:, -1] = command.position
        mode = np.broadcast_to(command.mode if modes is None else modes, self.n)[:, None]
        gain = np.where(mode == Mode.ACTIVE, command.gain, 0.0)
        scale = (self._supply / self._nominal_voltage) * (
            self._stiffness[:, None] * self._nominal_stiffness / self._nominal_stiffness[0]
        )
        self._gain[:, :, _KP] = scale * gain
        self._gain[:, :, _VMAX] = self._supply
        limit = np.where(mode == Mode.OFF, 0.0, self._braking)
        self._force[:, :, 0], self._force[:, :, 1] = -limit, limit

        # The command in force at a substep is the newest that was written at least `delay` before it.
        start = (np.arange(self.substeps) * TIMESTEP)[:, None] - self._delay[:, None, :]
        which = np.clip(np.floor(start / self.robot.dt + 1e-6).astype(int) + self._delayed - 1, 0, self._delayed - 1)
        control = np.take_along_axis(self._commands, which, 1) - self._zero[:, None]
        if self._friction.varies:
            self._step_by_step(control)
        else:
            self.batch.rollout(self.substeps, control, record=tuple(self._record), out=self._fresh)
        for key, value in self._record.items():
            value[:, : -self.substeps] = value[:, self.substeps :]
            value[:, -self.substeps :] = self._fresh[key]
        self.ticks += 1
        self.tick += 1

    def _step_by_step(self, control: Array) -> None:
        """A rollout whose gears' friction follows speed and load: it is set anew before every substep."""
        for i in range(self.substeps):
            force = self.batch.bind("actuator_force")
            self._loss[:, self._dof] = self._friction.at(self._state_qvel[:, self._dof], force)
            out = {key: value[:, i : i + 1].copy() for key, value in self._fresh.items()}
            self.batch.rollout(1, control[:, i : i + 1], record=tuple(self._record), out=out)
            for key, value in out.items():
                self._fresh[key][:, i : i + 1] = value

    @property
    def weight(self) -> float:
        """Of a nominal robot [N]."""
        return _GRAVITY * float(self.model.body_mass[1 : self._bodies].sum())

    @property
    def effort(self) -> Array:
        """True torque of the servos `(n, n_joints)` N m."""
        return self._record["actuator_force"][:, -1]

    def push(self, velocity: Array) -> None:
        """Change the bases' velocity by `(n, 2)` m/s, world frame."""
        self._state_qvel[:, :2] += velocity

    def move(self, world: int, places: Array) -> None:
        """Put the centres of the scene's spheres in one world to `(m, 3)` m."""
        self._mocap[world] = places

    def put(self, ids: Array, objects: Array) -> None:
        """Put the movable objects of the worlds `ids` `(k,)` to poses `(k, movable objects, 7)`, at rest."""
        self._objects.put(self._state_qpos, self._state_qvel, ids, objects)

    def observe(self) -> Observation:
        """What the rig's sensors say now: delayed, biased and noisy, and quantised but for those of the IMU."""
        rows, last = np.arange(self.n), self._record["qpos"].shape[1] - 1
        noise = self._draw_noise()
        at = last - self._joint_age
        column = rows[:, None]
        q = self._record["qpos"][column, at, self._qpos]
        self._play = np.clip(self._play, q - self._backlash / 2, q + self._backlash / 2)
        position = np.round((self._play + self._zero) / self._tick_angle) * self._tick_angle
        speed = self._record["qvel"][column, at, self._dof] + VELOCITY_NOISE * noise[:, 6:]
        velocity = np.round(speed / self._velocity_unit) * self._velocity_unit
        effort = (
            np.round(self._record["actuator_force"][column, at, np.arange(len(self._unit))] / self._unit) * self._unit
        )
        span = last - self._imu_age[:, None] - np.arange(self._imu_span)
        imu = self._record["sensordata"][rows[:, None], span, :6].mean(1)
        gyro, force = with_errors(imu, noise, self.robot.imu, self._tilt, self._gyro_bias, self._acc_bias)
        shape = position.shape
        voltage = np.round(self._supply / self._voltage_unit) * self._voltage_unit
        return Observation(
            time_ns=round(self.tick * self.robot.dt * 1e9),
            position=position,
            velocity=velocity,
            effort=effort,
            temperature=np.full(shape, np.nan),  # windings are not simulated here
            voltage=voltage,
            age=self._joint_age * TIMESTEP,
            fault=np.zeros(shape, int),
            orientation=np.full((self.n, 4), np.nan),  # no fusion on the board is simulated
            angular_velocity=gyro,
            specific_force=force,
            imu_age=(self._imu_age + 1) * TIMESTEP,
        )

    def _draw_noise(self) -> Array:
        """This tick's standard normal noise `(n, 6 + n_joints)`, refilled from each world's own stream.

        A second call within a tick gives the same.
        """
        block, row = np.divmod(self.ticks, NOISE_ROWS)
        for i in np.flatnonzero(block != self._noise_block):
            self._rngs[i].standard_normal(out=self._noise[i])
        self._noise_block[:] = block
        return self._noise[np.arange(self.n), row]


def with_errors(
    imu: Array, noise: Array, errors: Imu, tilt: Array, gyro_bias: Array, force_bias: Array
) -> tuple[Array, Array]:
    """Angular velocity and specific force, `(..., 3)` each, as an IMU errs about the true `imu` `(..., 6)`.

    `noise` `(..., 6)`, or longer, is standard normal; `tilt` `(..., 2)` are small mounting errors about x and y [rad].
    """
    gyro = _tilt(imu[..., 0:3], tilt) + gyro_bias + errors.gyro_noise * noise[..., 0:3]
    force = _tilt(imu[..., 3:6], tilt) + force_bias + errors.accelerometer_noise * noise[..., 3:6]
    return gyro, force


def _tilt(vector: Array, angles: Array) -> Array:
    """Turn `(..., 3)` by small angles `(..., 2)` about x and y."""
    x, y = angles[..., 0], angles[..., 1]
    return vector + np.stack([y * vector[..., 2], -x * vector[..., 2], x * vector[..., 1] - y * vector[..., 0]], -1)
