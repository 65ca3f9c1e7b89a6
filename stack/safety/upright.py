"""Upright at the home pose until the task begins, as the guard does in READY.

A standing robot is a pendulum on its ankles, whose servos are springs: soft ones hardly pull back harder than its
weight pulls on, so that zeros that are wrong by a degree make it lean by ten, or fall. So ankles answer how far the
base tilts from where it does at home, and how fast it turns. There is nothing that winds up: a robot on a slope, on a
stand or on a gantry gets an answer that stays, within `MOST`.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.stack.safety.balance import Balance, Feedback

GAINS = Balance(ankle_pitch=(0.05, 0.5))  # as ankles that are half as stiff again
MOST = 0.15  # rad that a joint may be from home: OP3s drawn at random need up to 0.10
LEANING = 0.35  # rad of tilt from which it is not standing: it is held, lies or falls


class Upright:
    """Where joints go to keep a standing robot upright; home, where nothing measures how it tilts."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._feedback, self._gains = robot, Feedback(robot), GAINS.gains
        self._senses = robot.imu.kind != "none"

    def goal(self, state: State, applied: Array) -> Array:
        """The next goal `(..., n_joints)` rad after `applied`, as slow as homing and inside the joints' ranges."""
        robot = self._robot
        if not self._senses:
            return applied
        wanted = self._feedback(robot.home + 0.0 * applied, state.gravity, state.angular_velocity, self._gains)
        low, high = robot.lower + robot.limits.margin, robot.upper - robot.limits.margin
        wanted = np.clip(np.clip(wanted, robot.home - MOST, robot.home + MOST), low, high)
        step = robot.limits.homing_speed * robot.dt
        stands = -state.gravity[..., 2:] > np.cos(LEANING)
        return np.where(stands, np.clip(wanted, applied - step, applied + step), applied)
