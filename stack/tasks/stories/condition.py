"""Whether an act is done, of one moment or of a whole trace: pure functions, for the robot's own estimate and for the
truth alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import SceneObject
from servoid.hw.geometry import rotate, turned, up_vector, yaw_of
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.stack.tasks.stories.act import PELVIS, Act

LIES = 0.25  # of a bag's upward axis: below that it lies, as in CLoSD
EDGE = 0.03  # m that the base's middle may be before a seat's edge: the pelvis reaches 0.04 m behind it
LOW = 0.07  # m of the base above a seat, at most, by which it sits
UPRIGHT, LEAN = 0.85, 0.35  # of the standing height, at least, and rad at most: it stands
# It is at rest where within so many seconds no joint of a leg moves by more than this and the base leans no other way.
# Not by the speed of the base: odometry counts on feet that carry, and drifts while the robot sits. Nor by its arms: a
# plan holds them a little otherwise than the one before it, and the base does not move by that.
REST_SECONDS, REST_JOINTS, REST_LEAN = 0.2, 0.03, 0.03  # s, rad, rad


@dataclass(frozen=True)
class Moment:
    """Of one tick, or of many along the first axis; in the odometry frame."""

    base: Array  # (..., 3) m
    orientation: Array  # (..., 4) of the base
    joints: Array  # (..., n_joints) rad
    still: Array  # (...,) bool


def moments(trace: Trace, legs: Array) -> Moment:
    """All ticks of a trace of a robot whose joints `legs` are those of its legs. Raises ValueError for a trace without
    orientation or joints."""
    if trace.orientation is None or trace.joints is None:
        raise ValueError("a trace without orientation or joints: no act can be judged by it")
    earlier = np.maximum(np.arange(len(trace.yaw)) - round(REST_SECONDS / trace.dt), 0)
    bent = trace.joints[:, legs]
    still = rests(bent, bent[earlier], trace.orientation, trace.orientation[earlier])
    return Moment(trace.displacement, trace.orientation, trace.joints, still)


def rests(joints: Array, joints_before: Array, orientation: Array, orientation_before: Array) -> Array:
    """Whether a robot is at rest `(...,)`, by the joints of its legs and its lean now and REST_SECONDS earlier."""
    moved = np.abs(joints - joints_before).max(-1)
    leant = np.linalg.norm(up_vector(orientation) - up_vector(orientation_before), axis=-1)
    return np.asarray((moved <= REST_JOINTS) & (leant <= REST_LEAN))


class Conditions:
    """What acts are done by, for one robot."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.legs = robot, robot.leg_index.reshape(-1)

    @cached_property
    def _points(self) -> KeyPoints:
        return KeyPoints(self._robot)

    def hold(self, act: Act, now: Moment, thing: Array, seat: SceneObject | None) -> Array:
        """Whether what the act is done by holds `(...,)`, of a thing with poses `(..., 7)`; `seat`: if it is one."""
        done = act.done
        found = np.ones(now.base.shape[:-1], bool)
        if done.part == PELVIS:
            found &= np.linalg.norm(now.base[..., :2] - thing[..., :2], axis=-1) <= done.within
        elif done.part is not None:
            at = self._points(now.joints)[..., self._points.names.index(done.part), :]
            found &= np.linalg.norm(now.base + rotate(now.orientation, at) - thing[..., :3], axis=-1) <= done.within
        if done.faces is not None:
            off = (yaw_of(now.orientation) - yaw_of(thing[..., 3:]) + np.pi) % (2 * np.pi) - np.pi
            found &= np.abs(off) <= done.faces
        if done.lies:
            found &= up_vector(thing[..., 3:])[..., 2] <= LIES
        if done.seated and seat is not None:
            x, y, up = np.moveaxis(turned(now.base - thing[..., :3], -yaw_of(thing[..., 3:])), -1, 0)
            found &= (np.abs(x) <= seat.size[0] / 2 + EDGE) & (np.abs(y) <= seat.size[1] / 2)
            found &= up - seat.size[2] / 2 <= LOW
        if done.upright:
            found &= now.base[..., 2] >= UPRIGHT * self._robot.standing_height
            found &= up_vector(now.orientation)[..., 2] >= np.cos(LEAN)
        return np.asarray(found & now.still if done.still else found)


def held_ticks(act: Act, dt: float) -> int:
    """Ticks in a row for which what an act is done by must hold."""
    return max(round(act.done.still / dt), 1)


def first(held: Array, ticks: int, begin: int) -> int | None:
    """The first tick from `begin` on by which it has held for so many ticks in a row since then; None where never."""
    run = 0
    for tick in range(begin, len(held)):
        run = run + 1 if held[tick] else 0
        if run >= ticks:
            return tick
    return None
