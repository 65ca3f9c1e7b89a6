"""Clips out of steps: goals of joints at times, played in physics, where the way of the base comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip
from servoid.stack.safety.balance import Feedback
from servoid.stack.safety.limits import limit
from servoid.tools.motions.keyframes import AuthoredClip, JointStep
from servoid.tools.motions.physics import play

AFTER_SECONDS = 0.5  # that the last step is held, so that what it leads to is seen


def stepped(wanted: AuthoredClip, robot: Robot, about: About) -> Clip:
    """Raises ConfigError for a joint that the robot does not have, or a goal beyond its range, and where the robot
    falls, which stands as the clip begins."""
    if wanted.begins != "upright" or wanted.after is not None:
        raise ConfigError(f"clip '{wanted.name}': steps begin at the home pose: leave out begins and after")
    goals = stepped_goals(wanted.steps, robot, f"clip '{wanted.name}'")
    held = np.concatenate([goals, np.repeat(goals[-1:], round(AFTER_SECONDS * robot.rate), 0)])
    feedback, gains = Feedback(robot), wanted.balance.gains
    played = play(
        held, robot, corrected=lambda target, truth: feedback(target, truth.gravity, truth.angular_velocity, gains)
    )
    if played.fallen.any():
        tick = int(played.fallen[0].argmax())
        raise ConfigError(f"clip '{wanted.name}': the robot falls {tick * robot.dt:.1f} s into it")
    # The goals alone, as the limits let them through: what corrects them is the performer's.
    alone = list(accumulate(held, lambda before, goal: limit(goal, before, robot), initial=robot.home))[1:]
    return replace(played.as_clip(wanted.name, about), joints=np.array(alone))


def stepped_goals(steps: Sequence[JointStep], robot: Robot, where: str = "steps") -> Array:
    """Goals `(ticks, n_joints)` rad at the robot's rate, from the home pose on. Raises ConfigError naming the step."""
    times, poses = [0.0], [robot.home]
    for number, step in enumerate(steps, 1):
        pose = (robot.home if step.home else poses[-1]).copy()
        for name, angle in step.joints.items():
            if name not in robot.names:
                raise ConfigError(f"{where}, step {number}: unknown joint '{name}': {nearest(name, robot.names)}")
            pose[robot.names.index(name)] = angle
        beyond = np.maximum(robot.lower - pose, pose - robot.upper) + robot.limits.margin
        if beyond.max() > 1e-6:
            joint = robot.names[int(beyond.argmax())]
            raise ConfigError(f"{where}, step {number}: {joint} goes {beyond.max():.2f} rad beyond its range")
        poses.append(pose)
        times.append(times[-1] + step.seconds)
        if step.hold:
            poses.append(pose)
            times.append(times[-1] + step.hold)
    ticks = max(round(times[-1] / robot.dt), 1)
    return through(np.array(times), np.array(poses), np.minimum(np.arange(1, ticks + 1) * robot.dt, times[-1]))


def through(times: Array, poses: Array, at: Array) -> Array:
    """Values at the times `at` `(k,)` of a curve through `poses` `(m, n)` at rising `times` `(m,)`.

    It rests where a joint turns back, and at both ends, and never goes beyond its neighbours: cubic pieces with the
    slopes of Fritsch and Butland, A method for constructing local monotone piecewise cubic interpolants, 1984.
    """
    width = np.diff(times)[:, None]
    rise = np.diff(poses, axis=0) / width
    slope = np.zeros_like(poses)
    before, after = 2.0 * width[1:] + width[:-1], width[1:] + 2.0 * width[:-1]
    same = rise[1:] * rise[:-1] > 0.0
    left, right = (np.where(same, one, 1.0) for one in (rise[:-1], rise[1:]))
    slope[1:-1] = np.where(same, (before + after) / (before / left + after / right), 0.0)
    piece = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    wide = width[piece]
    s = np.clip((at - times[piece])[:, None] / wide, 0.0, 1.0)
    low = (1.0 + 2.0 * s) * poses[piece] + s * wide * slope[piece]
    high = (3.0 - 2.0 * s) * poses[piece + 1] - (1.0 - s) * wide * slope[piece + 1]
    value: Array = (1.0 - s) ** 2 * low + s**2 * high
    return value
