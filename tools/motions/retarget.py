"""A person's motion on a robot: scaled, its feet on the ground where they stand, its joints within what servos can.

As in general motion retargeting (J. P. Araujo et al., 2025), key points are scaled about the root and followed by
inverse kinematics. Floating, sinking and sliding are not let arise: a foot that stands has one place, flat on the
ground, and weighs most.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.config import ConfigError, available, load_yaml, resolve
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip
from servoid.sim.poses.inverse import FollowedPoints, FollowWeights, Inverse
from servoid.tools.motions.human.key_points import SIDES, CapturedMotion
from servoid.tools.motions.standing import Standing

FROUDE = 0.524  # of a person's times: those of a body of the robot's size at equal weight and inertia
SPEED_SHARE = 0.95  # of the speed that the guard allows
_SPREAD = 0.2  # s about a tick that is too fast, that are slowed down with it
_ROUNDS, _LONGEST = 7, 5  # of slowing down, and to how many times the length
MOST_FLIGHT = 0.25  # s of a person: what is shorter becomes a step
LOWEST = 0.45  # lengths of the leg, of the hips above the feet
MOST_LEANING = 1.1  # rad of the trunk
_LEVEL = 0.8  # share of a foot's length that is level, where its heading is known
_TURNED_OUT = 0.5  # rad, of a foot against the body at most
_LIFT = 0.003  # m that a foot in the air is above the ground at least
_SHARED = 0.2  # s in which the weight goes from one foot to the other
_NEAR = 0.1  # weight of the centre of mass near the base, to that of balance
_GRAVITY = 9.81  # m/s2
_SMOOTH = 0.06  # s that the base's and the arms' way is averaged over


@dataclass(frozen=True)
class Arm:
    shoulder: tuple[float, float, float]
    upper_arm: str  # geom
    middle: float  # m from the shoulder to that geom's centre
    hand: str  # geom
    lengths: tuple[float, float]  # of upper arm and forearm


@dataclass(frozen=True)
class Proportions:
    """`configs/motions/retarget/ROBOT.yaml`."""

    stance: float
    bend: float
    stride: float
    stretched: dict[str, tuple[float, float]]
    arms: dict[str, Arm]
    weights: FollowWeights


def load_body(robot: Robot) -> Proportions:
    """Raises ConfigError for a robot that nobody has described so."""
    kind = "motions/retarget"
    if robot.name not in available(kind):
        raise ConfigError(f"{robot.name}: no configs/{kind}/{robot.name}.yaml says where its arms are: write one")
    return load_yaml(resolve(kind, robot.name), Proportions)


def retarget(motion: CapturedMotion, robot: Robot, name: str, about: About, *, pace: float = 1.0) -> Clip:
    """The clip of a motion, `pace` times as fast as bodies of its size move. Raises ConfigError."""
    standing, body = Standing(robot), load_body(robot)
    _check(motion, robot, name)
    asked = whole = _asked(_at_rate(motion, robot.rate * FROUDE / pace), standing, body)
    inverse = Inverse(robot, body.weights, body.stretched)
    time = np.arange(len(whole.base), dtype=float)  # of the ticks, in ticks of the whole
    offset = np.zeros((len(time), 2))  # of the centre of mass from the base
    for _ in range(_ROUNDS):
        centre = balanced(asked, robot.dt)
        joints, place, turn = inverse.follow(replace(asked, base=np.append(centre - offset, asked.base[:, 2:], 1)))
        offset = _smoothed(standing.statics.centre(joints, place, turn) - place[:, :2], _SHARED / robot.dt)
        goals = np.clip(standing.loaded(joints, place, turn, asked.carries), robot.lower, robot.upper)
        speed = np.abs(np.diff(goals, axis=0)).max(1) / (SPEED_SHARE * robot.limits.joint_speed * robot.dt)
        if speed.max() <= 1.0:
            return Clip(name, goals, place, turn, asked.carries.astype(float), about).placed()
        at = _slowed(1.05 * speed, round(_SPREAD * robot.rate))
        time, offset = _between(time[:, None], at)[:, 0], _between(offset, at)
        if len(time) > _LONGEST * len(whole.base):
            break
        asked = _resampled(whole, time)
    tick, joint = np.unravel_index(np.abs(np.diff(goals, axis=0)).argmax(), goals[1:].shape)
    raise ConfigError(
        f"clip '{name}': {robot.names[joint]} is too fast for its servo {tick / len(goals):.0%} into the motion, even "
        f"{len(goals) / len(whole.base):.1f} times as slow as a body of its size moves: cut that part out"
    )


def _check(motion: CapturedMotion, robot: Robot, name: str) -> None:
    """Raises ConfigError for a motion that leaves the ground, or is not on its feet."""
    if (flight := motion.flight()) > MOST_FLIGHT:
        raise ConfigError(
            f"clip '{name}': is {flight:.2f} s in the air, which the servos of {robot.name} cannot jump: cut it"
        )
    p = motion.points
    low = (p["hips"][:, 2] - np.minimum(p["left_ankle"], p["right_ankle"])[:, 2]) / motion.leg
    leaning = np.arccos(np.clip(_unit(p["neck"] - p["hips"])[:, 2], -1.0, 1.0))
    if low.min() < LOWEST or leaning.max() > MOST_LEANING:
        tick = int(low.argmin() if low.min() < LOWEST else leaning.argmax())
        raise ConfigError(
            f"clip '{name}': at {tick / motion.rate:.1f} s it is not on its feet (hips {low[tick]:.2f} of a leg above "
            f"them, trunk {leaning[tick]:.1f} rad from upright): only motions on the feet are retargeted: cut it"
        )


def balanced(asked: FollowedPoints, dt: float) -> Array:
    """A way of the centre of mass `(ticks, 2)` m whose zero-moment point is over the feet that carry, near the base's.

    Least squares over the whole motion of z = c - h / g c'' (M. Vukobratovic, B. Borovac, 2004), of a point mass at the
    height of the base.
    """
    n = len(asked.base)
    share = asked.carries / np.maximum(asked.carries.sum(-1, keepdims=True), 1)
    share = _smoothed(share, _SHARED / dt)
    on = share.sum(-1)
    support = (share[..., None] * asked.soles[..., :2]).sum(1) / np.maximum(on, 1e-9)[:, None]
    change = np.zeros((n, n))
    i = np.arange(1, n - 1)
    change[i, i - 1] = change[i, i + 1] = 1.0
    change[i, i] = -2.0
    point = np.eye(n) - (np.median(asked.base[:, 2]) / _GRAVITY / dt**2) * change
    weight = np.minimum(on, 1.0)[:, None]
    left = np.concatenate([weight * point, _NEAR * np.eye(n)])
    right = np.concatenate([weight * support, _NEAR * asked.base[:, :2]])
    return np.linalg.lstsq(left, right, rcond=None)[0]


def _resampled(asked: FollowedPoints, at: Array) -> FollowedPoints:
    """The same at times `at` [ticks of before]."""
    n = len(asked.base)
    soles = _between(asked.soles.reshape(n, -1), at).reshape(-1, *asked.soles.shape[1:])
    return FollowedPoints(
        _between(asked.base, at),
        _unit(_between(asked.turn, at)),
        soles,
        _between(asked.heading, at),
        asked.carries[np.floor(at).astype(int)] & asked.carries[np.ceil(at).astype(int)],
        {name: _between(place, at) for name, place in asked.geoms.items()},
    )


def _asked(motion: CapturedMotion, standing: Standing, body: Proportions) -> FollowedPoints:
    """What the robot is to follow, at its own size."""
    robot, legs = standing.robot, standing.legs
    p, stands = motion.points, motion.stands()
    inverse = standing.inverse
    reach = float(inverse.thigh[0] + inverse.shank[0])
    ankle = -float(inverse.sole[0, 2])  # above the ground where the foot is flat
    scale = body.bend * reach / motion.leg
    scales = scale * np.array([body.stride, body.stride, 1.0])
    hips = (p["left_hip"] + p["right_hip"]) / 2
    turn = _trunk(p)
    across = p["left_hip"] - p["right_hip"]
    yaw = np.unwrap(np.arctan2(-across[:, 0], across[:, 1]))
    floor = min(np.percentile(p[f"{side}_ankle"][:, 2], 2) for side in SIDES)
    origin = hips[0] * [1.0, 1.0, 0.0] + [0.0, 0.0, floor]
    width = np.median(np.linalg.norm(across, axis=-1)) / 2 * scale * body.stride
    soles, turns = np.empty((motion.ticks, 2, 3)), np.empty((motion.ticks, 2))
    for i, (side, sign) in enumerate(zip(SIDES, (1.0, -1.0), strict=True)):
        at = (p[f"{side}_ankle"] - origin) * scales
        wider = sign * (body.stance - width)
        at[:, :2] += wider * np.stack([-np.sin(yaw), np.cos(yaw)], -1)
        heading = yaw + _turned_out(p[f"{side}_toe"] - p[f"{side}_ankle"], yaw)
        soles[:, i], turns[:, i] = _planted(at, heading, stands[:, i])
    base = (hips - origin) * scales
    base[:, 2] += ankle - legs.offset[0, :3, 2].sum()
    base = _smoothed(base, _SMOOTH * robot.rate)
    arms = {}
    for side in SIDES:
        arm = body.arms[side]
        upper = _unit(p[f"{side}_elbow"] - p[f"{side}_shoulder"])
        fore = _unit(p[f"{side}_hand"] - p[f"{side}_elbow"])
        back = turn * np.array([1.0, -1.0, -1.0, -1.0])
        upper, fore = (_smoothed(rotate(back, way), _SMOOTH * robot.rate) for way in (upper, fore))
        shoulder = np.array(arm.shoulder)
        arms[arm.upper_arm] = shoulder + arm.middle * _unit(upper)
        arms[arm.hand] = shoulder + arm.lengths[0] * _unit(upper) + arm.lengths[1] * _unit(fore)
    smooth_turn = _smoothed(_continuous(turn), _SMOOTH * robot.rate)
    return FollowedPoints(base, _unit(smooth_turn), soles, turns, stands, arms)


def _trunk(points: Mapping[str, Array]) -> Array:
    """Quaternion `(ticks, 4)` of the trunk: its y axis along the hips, its z axis towards the neck."""
    up = _unit(points["neck"] - points["hips"])
    across = points["left_hip"] - points["right_hip"]
    y = _unit(across - (across * up).sum(-1, keepdims=True) * up)
    return _quaternion(np.stack([np.cross(y, up), y, up], -1))


def _turned_out(way: Array, yaw: Array) -> Array:
    """Heading `(ticks,)` of a foot against the body's, rad: where it points up or down, from before and after."""
    angle = np.arctan2(way[:, 1], way[:, 0]) - yaw
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    level = np.flatnonzero(np.linalg.norm(way[:, :2], axis=-1) > _LEVEL * np.linalg.norm(way, axis=-1))
    if len(level) == 0:
        return np.zeros(len(way))
    return np.clip(np.interp(np.arange(len(way)), level, angle[level]), -_TURNED_OUT, _TURNED_OUT)


def _planted(at: Array, heading: Array, stands: Array) -> tuple[Array, Array]:
    """Places `(ticks, 3)` and headings `(ticks,)` of a sole that has one place while it stands, and is above the ground
    while it does not; in the air, what that moved at both ends is shared out over the way."""
    out, yaw = at.copy(), heading.copy()
    edges = np.flatnonzero(np.diff(np.r_[False, stands, False].astype(int))).reshape(-1, 2)
    for first, last in edges:
        out[first:last] = np.append(at[first:last, :2].mean(0), 0.0)
        yaw[first:last] = heading[first:last].mean()
    gaps = [(last - 1, first) for (_, last), (first, _) in itertools.pairwise(edges)]
    gaps += [(-1, int(edges[0, 0]))] if len(edges) and edges[0, 0] > 0 else []
    gaps += [(int(edges[-1, 1]) - 1, len(at))] if len(edges) and edges[-1, 1] < len(at) else []
    for last, first in gaps:
        ticks = np.arange(last + 1, first)
        share = ((ticks - last) / (first - last))[:, None]
        before = out[last] - at[last] if last >= 0 else out[first] - at[first]
        after = out[first] - at[first] if first < len(at) else before
        out[ticks] = at[ticks] + before + share * (after - before)
        turn_before = yaw[last] - heading[last] if last >= 0 else yaw[first] - heading[first]
        turn_after = yaw[first] - heading[first] if first < len(at) else turn_before
        yaw[ticks] = heading[ticks] + turn_before + share[:, 0] * (turn_after - turn_before)
    out[~stands, 2] = np.maximum(out[~stands, 2], _LIFT)
    return out, yaw


def _at_rate(motion: CapturedMotion, rate: float) -> CapturedMotion:
    """Resampled to `rate` ticks a second of the motion's own time."""
    times = np.arange(int((motion.ticks - 1) / motion.rate * rate) + 1) / rate * motion.rate
    if len(times) < 2:
        raise ConfigError("the motion is shorter than two of the robot's ticks")
    return CapturedMotion(rate, {name: _between(at, times) for name, at in motion.points.items()})


def _between(values: Array, at: Array) -> Array:
    low = np.clip(np.floor(at).astype(int), 0, len(values) - 2)
    return values[low] + (at - low)[:, None] * (values[low + 1] - values[low])


def _slowed(speed: Array, spread: int) -> Array:
    """Times [ticks of before] of the ticks of a motion that is slower where `speed` `(ticks - 1,)` is above 1."""
    most = np.maximum(speed, 1.0)
    padded = np.pad(most, spread, mode="edge")
    longer = np.max([padded[i : i + len(most)] for i in range(2 * spread + 1)], axis=0)
    window = np.ones(2 * spread + 1) / (2 * spread + 1)
    longer = np.maximum(np.convolve(np.pad(longer, spread, mode="edge"), window, "valid"), most)
    ends = np.r_[0.0, np.cumsum(longer)]
    return np.interp(np.arange(int(ends[-1]) + 1), ends, np.arange(len(ends)))


def _smoothed(values: Array, ticks: float) -> Array:
    n = max(round(ticks), 1) | 1
    window = np.ones(n) / n
    return np.stack([np.convolve(np.pad(c, n // 2, mode="edge"), window, "valid") for c in values.T], -1)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _continuous(turn: Array) -> Array:
    sign = np.cumprod(np.r_[1.0, np.where((turn[1:] * turn[:-1]).sum(-1) < 0.0, -1.0, 1.0)])
    return turn * sign[:, None]


def _quaternion(rotation: Array) -> Array:
    """Quaternions w x y z of rotations `(ticks, 3, 3)`."""
    r = rotation
    trace = np.stack(
        [
            1.0 + r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2],
            1.0 + r[:, 0, 0] - r[:, 1, 1] - r[:, 2, 2],
            1.0 - r[:, 0, 0] + r[:, 1, 1] - r[:, 2, 2],
            1.0 - r[:, 0, 0] - r[:, 1, 1] + r[:, 2, 2],
        ],
        -1,
    )
    size = np.sqrt(np.maximum(trace, 1e-12)) / 2
    sign = np.stack(
        [
            np.ones(len(r)),
            np.sign(r[:, 2, 1] - r[:, 1, 2]),
            np.sign(r[:, 0, 2] - r[:, 2, 0]),
            np.sign(r[:, 1, 0] - r[:, 0, 1]),
        ],
        -1,
    )
    return _unit(size * np.where(sign == 0.0, 1.0, sign))
