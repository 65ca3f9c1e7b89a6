"""The simulated body behind the hardware contracts: one world, whose time advances when its clock is slept on.

Where the scene has other robots, they are in the same world, each a body of its own behind the same contracts.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import Array, Command, Mode, Observation
from servoid.hw.contracts.world import Scene, Start, World
from servoid.hw.robot.description import Robot
from servoid.hw.seeds import Stream, generator
from servoid.sim.model import build
from servoid.sim.scene import Stage, count_robots
from servoid.sim.truth import SimulatedTruth
from servoid.sim.worlds import Worlds


class SimBackend:
    """A robot in MuJoCo. `stage` is the scene in play, None without one."""

    name = "sim"

    def __init__(
        self,
        robot: Robot,
        *,
        seed: int = 0,
        randomise: bool = False,
        scene: Scene | None = None,
        start: Start | None = None,
    ) -> None:
        """`start` says how the robot begins, in one row; others of the scene begin as that says."""
        n = count_robots(scene)
        self._robot = robot
        self._worlds = Worlds(
            robot, n, threads=1, randomise=float(randomise), model=build(robot, scene), together=n > 1
        )
        rngs = [
            generator(seed, Stream.BODY),
            *(generator(seed, Stream.TEAMMATES, number) for number in range(1, n)),
        ]
        start, places = start or Start(), np.zeros((n, 3))
        if scene is not None and scene.robots is not None:
            places[1:] = scene.robots[:, :3]
            start = Start(position=places * [1.0, 1.0, np.nan], heading=places[:, 2])
        self._worlds.reset(np.arange(n), rngs, start)
        self._commands = [Command(robot.home, np.zeros(len(robot.joints)), Mode.OFF)] * n
        self.clock = SimClock(self)
        self.stage: Stage | None = None
        teammates: tuple[Teammate, ...] = ()
        if scene is not None:
            self.stage = Stage(scene, self.truth, robot.dt, lambda places: self._worlds.move(0, places))
            teammates = tuple(Teammate(self, scene, number) for number in range(1, n))
        self.simulation = Simulation(self.truth, self.push, self.stage, teammates)

    @property
    def truth(self) -> SimulatedTruth:
        """The world's truth; arrays have a leading dimension of one, or of all robots, this one first."""
        return self._worlds.truth

    @property
    def qpos(self) -> Array:
        """MuJoCo's generalised position, to render from."""
        return self._worlds.truth.qpos[0]

    def connect(self) -> tuple[SimSensors, SimMotors]:
        """The robot stands on the ground at its home pose with torque off."""
        return SimSensors(self._worlds, 0), SimMotors(self, 0)

    def push(self, velocity: Array) -> None:
        """Change the base's velocity by `(2,)` m/s, world frame."""
        self._push(0, velocity)

    def close(self) -> None:
        self._commands[0] = _off(self._commands[0])

    def _step(self) -> None:
        """Let time go on by a tick."""
        position, gain = (np.stack([getattr(c, part) for c in self._commands]) for part in ("position", "gain"))
        modes = np.array([command.mode for command in self._commands])
        self._worlds.step(Command(position, gain, self._commands[0].mode), modes)

    def _push(self, number: int, velocity: Array) -> None:
        changes = np.zeros((self._worlds.n, 2))
        changes[number] = velocity
        self._worlds.push(changes)


class Teammate:
    """Another robot of the same world, by its number from 1 on. Its time goes on with the first one's."""

    def __init__(self, world: SimBackend, scene: Scene, number: int) -> None:
        self.name = world.name
        self._world, self._number = world, number
        self.clock = TeammateClock(world.clock)
        stage = Stage(scene, world.truth, world._robot.dt, lambda places: None, number)
        self.simulation = Simulation(world.truth, partial(world._push, number), stage)

    def connect(self) -> tuple[SimSensors, SimMotors]:
        """It stands where the scene puts it, at its home pose with torque off."""
        return SimSensors(self._world._worlds, self._number), SimMotors(self._world, self._number)

    def close(self) -> None:
        self._world._commands[self._number] = _off(self._world._commands[self._number])


class SimClock:
    """Simulated time [ns]: sleeping advances the physics, in whole ticks, and nothing else does."""

    def __init__(self, backend: SimBackend) -> None:
        self._backend = backend
        self._tick_ns = round(backend._robot.dt * 1e9)

    def now_ns(self) -> int:
        return self._backend._worlds.tick * self._tick_ns

    def sleep_until(self, time_ns: int) -> None:
        while self.now_ns() + self._tick_ns <= time_ns:
            self._backend._step()


class TeammateClock:
    """Simulated time [ns] of a robot that is driven between two steps of the world, and never sleeps by itself."""

    def __init__(self, clock: SimClock) -> None:
        self._clock = clock

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def sleep_until(self, time_ns: int) -> None:
        if time_ns > self.now_ns():
            raise RuntimeError("the time of a world of several robots goes on by the first one's clock alone")


class SimSensors:
    """Reads the sensors of a body of the world. Reading twice within a tick draws noise once."""

    def __init__(self, worlds: World, number: int) -> None:
        self._worlds, self._number = worlds, number

    def read(self) -> Observation:
        o, i = self._worlds.observe(), self._number
        return Observation(
            time_ns=o.time_ns,
            position=o.position[i],
            velocity=o.velocity[i],
            effort=o.effort[i],
            temperature=o.temperature[i],
            voltage=o.voltage[i],
            age=o.age[i],
            fault=o.fault[i],
            orientation=o.orientation[i],
            angular_velocity=o.angular_velocity[i],
            specific_force=o.specific_force[i],
            imu_age=o.imu_age[i],
        )


class SimMotors:
    """Takes commands; they act from the next tick on, after the servo's own delay."""

    def __init__(self, backend: SimBackend, number: int) -> None:
        self._backend, self._number = backend, number

    def write(self, command: Command) -> None:
        self._backend._commands[self._number] = Command(command.position.copy(), command.gain.copy(), command.mode)


def _off(command: Command) -> Command:
    return Command(command.position, command.gain, Mode.OFF)
