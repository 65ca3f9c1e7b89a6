"""Measures of a finished run, pure functions of its trace."""

from __future__ import annotations

import itertools

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace

SETTLING = 2.0  # s after a change of command that do not count toward the velocity error
STANDING_SPEED = 0.05  # m/s
STANDING_TIME = 1.0  # s
SMOOTHING = 0.2  # s over which velocity is averaged, so that an estimate's noise is not taken for motion


def velocity_error(trace: Trace, cycle: float) -> float:
    """Mean over whole gait cycles of |measured - commanded| planar velocity [m/s].

    The velocity is averaged over each cycle of `cycle` s before the norm is taken, because a walking base sways.
    Cycles start 2 s after each change of command (the start is one). NaN when the run has no such cycle.
    """
    ticks = max(round(cycle / trace.dt), 1)
    changes = np.flatnonzero(np.any(np.diff(trace.command, axis=0) != 0.0, axis=1)) + 1
    bounds = np.concatenate([[0], changes, [len(trace.command)]])
    errors = []
    for start, end in itertools.pairwise(bounds):
        for first in range(start + round(SETTLING / trace.dt), end - ticks + 1, ticks):
            measured = trace.velocity[first : first + ticks, :2].mean(axis=0)
            errors.append(np.linalg.norm(measured - trace.command[first, :2]))
    return float(np.mean(errors)) if errors else float("nan")


def mean_twists(trace: Trace, window: float) -> Array:
    """Mean m/s forward, m/s left and rad/s `(n, 3)` over one whole `window` s after the other."""
    ticks = round(window / trace.dt)
    count = len(trace.yaw) // ticks
    velocity = trace.velocity[: count * ticks, :2].reshape(count, ticks, 2).mean(1)
    yaw = np.unwrap(trace.yaw)[: count * ticks].reshape(count, ticks)
    return np.column_stack([velocity, (yaw[:, -1] - yaw[:, 0]) / ((ticks - 1) * trace.dt)])


def top_speed(trace: Trace, window: float = 2.0) -> float:
    """Highest mean forward speed over `window` s [m/s]; NaN for a shorter run."""
    ticks = round(window / trace.dt)
    if len(trace.velocity) < ticks:
        return float("nan")
    return float(_moving_average(trace.velocity[:, :1], ticks).max())


def steady_speed(trace: Trace) -> float:
    """Mean forward speed from 2 s on [m/s]; NaN for a shorter run."""
    speeds = trace.velocity[round(SETTLING / trace.dt) :, 0]
    return float(speeds.mean()) if len(speeds) else float("nan")


def turning_rate(trace: Trace) -> float:
    """How fast the robot turned from 2 s on, either way [rad/s]; NaN for a shorter run."""
    yaw = np.unwrap(trace.yaw)[round(SETTLING / trace.dt) :]
    return float(abs(yaw[-1] - yaw[0]) / ((len(yaw) - 1) * trace.dt)) if len(yaw) > 1 else float("nan")


def path_length(trace: Trace, step: float) -> float:
    """Length of the planar path [m], its points taken `step` s apart, so that the gait's sway is not counted."""
    ticks = max(round(step / trace.dt), 1)
    points = trace.displacement[:, :2]
    if len(points) == 0:
        return 0.0
    points = np.concatenate([points[:-1:ticks], points[-1:]])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def clearance(trace: Trace, ticks: slice = slice(None)) -> float:
    """Least distance [m] of the base from the surface of an obstacle; NaN where there is none."""
    if trace.obstacles is None or not trace.obstacles.size:
        return float("nan")
    obstacles = trace.obstacles[ticks]
    apart = np.linalg.norm(obstacles[..., :2] - trace.displacement[ticks, None, :2], axis=-1)
    return float((apart - obstacles[..., 2]).min())


def touched(trace: Trace) -> bool:
    """Whether the robot touched an obstacle. One that cannot feel it believes so where its base is inside one."""
    return clearance(trace) < 0.0 if trace.touched is None else trace.touched


def standing(trace: Trace) -> bool:
    """Whether the run ended standing: smoothed planar speed below 0.05 m/s over all of its last second."""
    ticks, smooth = round(STANDING_TIME / trace.dt), max(round(SMOOTHING / trace.dt), 1)
    if len(trace.velocity) < ticks:
        return False
    speeds = np.linalg.norm(_moving_average(trace.velocity[-ticks:, :2], smooth), axis=1)
    return bool(np.all(speeds < STANDING_SPEED))


def _moving_average(values: Array, ticks: int) -> Array:
    """Means over windows of `ticks` rows: `(rows - ticks + 1, columns)`."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (total[ticks:] - total[:-ticks]) / ticks
