"""What the joints of a hanging robot are asked to do, so that their servos show what they are like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.tools.identify.hanging import hanging_model

HELD_OUT = "sines"  # the motion that nothing is fitted on
AMPLITUDE = 0.3  # rad about the middle pose
_REST = 0.5  # s before each motion, so that it begins still
_STEPS, _STEP_SECONDS = (1.0, 0.0, -1.0, 0.0, 0.5, -0.5, 0.0), 0.7
_RAMP_SHARE, _RAMP_SPEED = 0.6, 0.15  # of the amplitude; rad/s: slow enough for friction at rest to show
_CHIRP, _CHIRP_SECONDS = (0.4, 3.5), 5.0  # Hz
_SINES, _SINES_SECONDS = (0.45, 1.1, 1.9), 5.0  # Hz
_SPEED_SHARE = 0.8  # of the robot's joint speed, that chirp and sines reach at most
_LEAST = 0.05  # rad: with less room, a joint shows its friction alone
_SEED = 17


@dataclass(frozen=True)
class Exercise:
    """A motion of some joints: goals `(ticks, n_joints)` rad that begin and end in the middle pose."""

    name: str
    goals: Array


def plan(robot: Robot, groups: Sequence[Sequence[str]], amplitude: float = AMPLITUDE) -> list[Exercise]:
    """The motions of each group of joints, one group after the other, while the others hold still.

    The middle pose is the home pose, inside the ranges; mirrored joints move as in walking, so that legs keep apart
    and the base is shaken little. Raises ConfigError for a joint without room, and where limbs would touch.
    """
    middle = middle_pose(robot)
    room = np.minimum(np.minimum(middle - robot.lower, robot.upper - middle) - robot.limits.margin, amplitude)
    names = {name for group in groups for name in group}
    if tight := [name for i, name in enumerate(robot.names) if name in names and room[i] < _LEAST]:
        raise ConfigError(
            f"{', '.join(tight)}: less than {_LEAST:g} rad of room about the home pose: leave out with --joints"
        )
    for _ in range(12):
        motions = [motion for group in groups for motion in _motions(robot, middle, room, group)]
        touching = _touch(robot, middle, motions)
        if touching is None:
            return motions
        room = 0.8 * room
    raise ConfigError(f"{touching} would touch however small the motion: change the home pose, or use fewer --joints")


def middle_pose(robot: Robot) -> Array:
    """The pose that motions begin and end in `(n_joints,)` rad."""
    margin = robot.limits.margin
    return np.clip(robot.home, robot.lower + margin, robot.upper - margin)


def _motions(robot: Robot, middle: Array, room: Array, group: Sequence[str]) -> list[Exercise]:
    rng, n = np.random.default_rng(_SEED), len(robot.joints)
    moving = np.array([name in group for name in robot.names])
    index, sign = robot.mirror
    way, phase = rng.choice([-1.0, 1.0], n), rng.uniform(0.0, 2.0 * np.pi, (len(_SINES), n))
    for i, other in enumerate(index):
        if i > other:
            way[i], phase[:, i] = -way[other] * sign[i], phase[:, other]
    reach, dt, fast = room * moving, robot.dt, _SPEED_SHARE * robot.limits.joint_speed
    rest = np.zeros((round(_REST / dt), n))

    def motion(name: str, shape: Array) -> Exercise:
        return Exercise(name, middle + way * np.concatenate([rest, shape, rest]))

    steps = np.repeat(np.array(_STEPS)[:, None] * reach, round(_STEP_SECONDS / dt), 0)
    quarter = max(round(_RAMP_SHARE * float(reach.max()) / _RAMP_SPEED / dt), 1)
    up = np.linspace(0.0, 1.0, quarter + 1)[1:]
    ramps = np.concatenate([up, 1 - up, -up, up - 1])[:, None] * _RAMP_SHARE * reach
    t = np.arange(round(_CHIRP_SECONDS / dt)) * dt
    low, high = _CHIRP
    frequency = low * (high / low) ** (t / _CHIRP_SECONDS)
    swing = np.minimum(reach, (fast / (2.0 * np.pi * frequency))[:, None])
    fade = np.clip((t[-1] - t) / 0.3, 0.0, 1.0)[:, None]
    chirp = fade * swing * np.sin(2.0 * np.pi * np.cumsum(frequency) * dt)[:, None]
    t = np.arange(round(_SINES_SECONDS / dt)) * dt
    fade = np.clip(np.minimum(t, t[-1] - t) / 0.5, 0.0, 1.0)[:, None]
    waves = sum(np.sin(2.0 * np.pi * f * t[:, None] + phase[i]) for i, f in enumerate(_SINES))
    share = np.minimum(reach / len(_SINES), fast / (2.0 * np.pi * sum(_SINES)))
    return [
        motion("steps", steps),
        motion("ramps", ramps),
        motion("chirp", chirp),
        motion(HELD_OUT, fade * share * waves),
    ]


def _touch(robot: Robot, middle: Array, motions: Sequence[Exercise]) -> str | None:
    """The first two bodies that touch in a motion and do not in the middle pose; None where none do."""
    import mujoco

    model = hanging_model(robot, collide=True)
    data = mujoco.MjData(model)
    joints = np.array([int(model.joint(name).qposadr[0]) for name in robot.names])

    def pairs(pose: Array) -> set[tuple[str, str]]:
        data.qpos[joints] = pose
        mujoco.mj_fwdPosition(model, data)
        bodies = model.geom_bodyid[data.contact.geom]
        return {(model.body(int(a)).name, model.body(int(b)).name) for a, b in bodies}

    always = pairs(middle)
    for motion in motions:
        for pose in motion.goals[:: max(round(0.1 * robot.rate), 1)]:
            if found := pairs(pose) - always:
                return " and ".join(min(found))
    return None
