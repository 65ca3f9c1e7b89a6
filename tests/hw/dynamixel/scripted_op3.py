"""An OP3 on the scripted bus, as its file describes it, and a loop to run it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scripted import Memory, ScriptedBus

from servoid.hw.contracts.body import Command, Mode, Observation
from servoid.hw.dynamixel.backend import DynamixelBackend, DynamixelSensors
from servoid.hw.dynamixel.motors import DynamixelMotors
from servoid.hw.robot.description import load_robot

ROBOT = load_robot("op3")
TICK_NS = 20_000_000
MOVING = {"goal_position", "goal_velocity", "goal_current", "goal_pwm", "torque_enable"}


class Robot:
    """A scripted OP3 as its file describes it, standing at home, and a loop of its own."""

    def __init__(self) -> None:
        self.servos = []
        for joint in ROBOT.joints:
            servo = Memory("xm430-w350", joint.id)
            servo.put("return_delay_time", 0)
            servo.put("present_input_voltage", 120)
            servo.put("present_temperature", 30 + joint.id)
            servo.put("present_position", 2048 + round(joint.home / (2 * np.pi) * 4096))
            low, high = (joint.range[end] / (2 * np.pi) * 4096 for end in (0, 1))
            servo.put("min_position_limit", 2048 + int(np.floor(low)))
            servo.put("max_position_limit", 2048 + int(np.ceil(high)))
            self.servos.append(servo)
        self.board = Memory("opencr", 200)
        self.line = ScriptedBus([*self.servos, self.board])
        self.line.before_answer = lambda packet: self.live()
        self.noise = 0

    def live(self) -> None:
        """The IMU's noise, and servos that are where they are told."""
        self.noise += 1
        self.board.put("acceleration_z", 16384 + self.noise % 7)

    def backend(self, **options: bool) -> DynamixelBackend:
        return DynamixelBackend(ROBOT, port=self.line, clock=self.line, **options)

    def joint(self, name: str) -> Memory:
        return self.servos[ROBOT.names.index(name)]

    def moved(self) -> list[tuple[str, int]]:
        return [write for servo in self.servos for write in servo.writes if write[0] in MOVING]


def active(position: np.ndarray | None = None, gain: float = 1.0) -> Command:
    return Command(ROBOT.home if position is None else position, np.full(20, gain), Mode.ACTIVE)


def run(
    robot: Robot,
    sensors: DynamixelSensors,
    motors: DynamixelMotors,
    ticks: int,
    until: Callable[[Observation], bool] = lambda o: False,
) -> tuple[int, Observation]:
    """Ticks until a condition holds; how many it took."""
    for tick in range(ticks):
        robot.line.sleep_until((robot.line.time // TICK_NS + 1) * TICK_NS)
        observation = sensors.read()
        if until(observation):
            return tick + 1, observation
        motors.write(active())
    return ticks, observation
