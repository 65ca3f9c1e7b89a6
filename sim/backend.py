"""The simulated body behind the hardware contracts: one world, whose time advances when its clock is slept on."""

from __future__ import annotations

import numpy as np

from hw.hal import Array, Command, Mode, Observation, Percept, Scene, State
from hw.robot import Robot
from sim.model import build
from sim.scene import Stage
from sim.truth import Truth
from sim.worlds import Worlds


class SimBackend:
    """A robot in MuJoCo. `truth` and `stage` are for evaluation; of them, the loop is only shown what `look` sees.

    `stage` is the scene in play, None without one.
    """

    name = "sim"

    def __init__(self, robot: Robot, *, seed: int = 0, randomise: bool = False, scene: Scene | None = None) -> None:
        self._robot = robot
        self._worlds = Worlds(robot, 1, threads=1, randomise=float(randomise), model=build(robot, scene))
        self._worlds.reset(np.array([0]), [np.random.default_rng([seed, 0])])
        self._command = Command(robot.home[None], np.zeros((1, len(robot.joints))), Mode.OFF)
        self.clock = SimClock(self)
        self.stage: Stage | None = None
        if scene is not None:
            self.stage = Stage(scene, self.truth, robot.dt, lambda places: self._worlds.move(0, places))

    @property
    def truth(self) -> Truth:
        """The world's truth; arrays have a leading dimension of one."""
        return self._worlds.truth

    @property
    def qpos(self) -> Array:
        """MuJoCo's generalised position, to render from."""
        return self._worlds.truth.qpos[0]

    def connect(self) -> tuple[SimSensors, SimMotors]:
        """The robot stands on the ground at its home pose with torque off."""
        return SimSensors(self._worlds), SimMotors(self)

    def push(self, velocity: Array) -> None:
        """Change the base's velocity by `(2,)` m/s, world frame."""
        self._worlds.push(np.asarray(velocity)[None])

    def look(self, state: State) -> Percept:
        """What the robot sees of the scene (see `hw.hal.Surroundings`)."""
        assert self.stage is not None, "there is no scene"
        return self.stage.look(state)

    def close(self) -> None:
        self._command = Command(self._command.position, self._command.gain, Mode.OFF)


class SimClock:
    """Simulated time [ns]: sleeping advances the physics, in whole ticks, and nothing else does."""

    def __init__(self, backend: SimBackend) -> None:
        self._backend = backend
        self._tick_ns = round(backend._robot.dt * 1e9)

    def now_ns(self) -> int:
        return self._backend._worlds.tick * self._tick_ns

    def sleep_until(self, time_ns: int) -> None:
        while self.now_ns() + self._tick_ns <= time_ns:
            self._backend._worlds.step(self._backend._command)


class SimSensors:
    """Reads the world's sensors. Reading twice within a tick draws noise once."""

    def __init__(self, worlds: Worlds) -> None:
        self._worlds = worlds

    def read(self) -> Observation:
        o = self._worlds.observe()
        return Observation(
            time_ns=o.time_ns,
            position=o.position[0],
            velocity=o.velocity[0],
            effort=o.effort[0],
            temperature=o.temperature[0],
            voltage=o.voltage[0],
            age=o.age[0],
            fault=o.fault[0],
            orientation=o.orientation[0],
            angular_velocity=o.angular_velocity[0],
            specific_force=o.specific_force[0],
            imu_age=o.imu_age[0],
        )


class SimMotors:
    """Takes commands; they act from the next tick on, after the servo's own delay."""

    def __init__(self, backend: SimBackend) -> None:
        self._backend = backend

    def write(self, command: Command) -> None:
        self._backend._command = Command(command.position[None].copy(), command.gain[None].copy(), command.mode)
