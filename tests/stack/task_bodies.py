"""Bodies for tests of tasks."""

from __future__ import annotations

import numpy as np

from hw.hal import State


def state(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> State:
    return State(
        time_ns=0,
        orientation=np.array([np.cos(0.5 * yaw), 0, 0, np.sin(0.5 * yaw)]),
        gravity=np.array([0, 0, -1.0]),
        yaw=np.array(yaw),
        angular_velocity=np.zeros(3),
        velocity=np.zeros(3),
        displacement=np.array([x, y, 0.26]),
        position=np.zeros(20),
        joint_velocity=np.zeros(20),
        contact=np.ones(2),
    )
