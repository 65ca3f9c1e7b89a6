"""An analytic walking reference for any planar velocity and yaw rate, by foot trajectories and leg inverse kinematics.

It is the first reference that the tracker learns on, and with gyro feedback the scripted baseline. One instance walks
one robot or many worlds: arrays carry any leading dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from servoid.hw.config import load_yaml, resolve
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, ReferenceFrames
from servoid.hw.geometry import headed, joined, turned
from servoid.hw.robot.description import Robot
from servoid.hw.robot.inverse import NumericInverse, leg_inverse, stance_at_home
from servoid.hw.robot.legs import ALONG, LegInverse, Legs

_SMOOTH = 0.3  # of a smooth swing's easing that is left at full speed
_FASTEST = 8.0  # rad/s of the reference that count for `yaw_lead`: where a swing begins and ends, there are jumps
_NOW = np.array([0])
_LOWERING = 0.04  # m/s at which the base goes lower and rises again
_ACROSS = 5.0  # rad/s of turning that weigh as much as 1 m/s sideways


@dataclass(frozen=True)
class GaitSettings:
    """Lengths m, times s, speeds m/s and rad/s. `*_gain` are of the gyro feedback [s]."""

    cycle: float  # of two steps
    double_support: float  # share of a step that both feet carry
    height: float  # ankle below hip
    foot_forward: float  # feet ahead of the hips
    foot_apart: float  # feet outward of the hips
    lean: float  # forward pitch of the base, rad
    lift: float
    sway: float
    arm_swing: float  # rad for each m/s forward
    sideways_gain: float  # soft legs drag their feet: how much longer than asked steps to the side are
    backward_gain: float  # and steps backward
    backward_lean: float  # rad that the base leans further forward for each m/s backward, so that its heels come free
    backward_shift: float  # m that the feet trail for each m/s backward
    max_velocity: tuple[float, float, float]  # forward, sideways, turning
    max_backward: float  # m/s
    even_swing: tuple[float, float]  # m/s forward between which swings grow even: smooth ones ask for too fast joints
    acceleration: tuple[float, float, float]  # a second
    ankle_pitch_gain: float
    ankle_roll_gain: float
    turning_gain: float = 1.0  # soles slip as they turn: how much further than asked steps turn
    yaw_lead: float = 0.0  # s of their rate that the goals of joints that turn the feet go ahead by, for servos lag
    lift_loss: float = 0.0  # m that steps are lower at the faster speed of `even_swing`: knees are too slow for both
    lower_shift: float = 0.5  # m that the feet are further ahead for each m that the base goes lower: knees weigh, too


@cache
def load_gait(name: str = "gait") -> GaitSettings:
    """By a name in configs/policies/, or by file. Raises ConfigError."""
    return load_yaml(resolve("policies", name), GaitSettings)


def gait_of(robot: Robot) -> GaitSettings:
    """Settings of the robot's own gait; where it has none, the shipped one's, scaled to its legs and its stance at
    home, which no one has tried. Raises ConfigError."""
    if robot.gait:
        return load_gait(robot.gait)
    shipped, stance = load_gait(), stance_at_home(robot, Legs(robot))
    size = stance.height / shipped.height
    time = float(np.sqrt(size))  # alike robots walk alike: a Froude number keeps lengths, and times to their root
    beside = np.sign(stance.hip[:, 1]) * (stance.ankle[:, 1] - stance.hip[:, 1])
    forward, sideways, turning = shipped.max_velocity
    ahead, aside, around = shipped.acceleration
    low, high = shipped.even_swing
    return replace(
        shipped,
        cycle=shipped.cycle * time,
        height=stance.height,
        foot_forward=float((stance.ankle[:, 0] - stance.hip[:, 0]).mean()),
        foot_apart=float(beside.mean()),
        lean=stance.lean,
        lift=shipped.lift * size,
        lift_loss=shipped.lift_loss * size,
        sway=shipped.sway * size,
        arm_swing=shipped.arm_swing / time,
        backward_lean=shipped.backward_lean / time,
        backward_shift=shipped.backward_shift * time,
        max_velocity=(forward * time, sideways * time, turning / time),
        max_backward=shipped.max_backward * time,
        even_swing=(low * time, high * time),
        acceleration=(ahead, aside, around / size),
    )


class Gait(Reference):
    """The walking reference. `command` `(..., 3)` is slewed, so that steps change gradually.

    Standing is the same motion with no lift and no sway: `activity` (0 to 1) fades the steps in and out.
    """

    def __init__(
        self,
        robot: Robot,
        shape: tuple[int, ...] = (),
        settings: GaitSettings | None = None,
        inverse: LegInverse | NumericInverse | None = None,
    ) -> None:
        """`shape` are the leading dimensions; `settings` are by default those of `gait_of`; many gaits of a robot
        may share an `inverse`. Raises ConfigError."""
        self.robot, self.settings = robot, settings or gait_of(robot)
        settings = self.settings
        self._inverse, self._index = inverse or leg_inverse(robot), Legs(robot).index
        self._side = np.sign(self._inverse.hip[:, 1])  # 1 left, -1 right
        self._shift = np.where(self._side > 0, 0.0, 0.5)  # the right foot steps half a cycle later
        self._turns = _turning(robot)
        self._arms = [(robot.names.index(name), sign) for name, sign in robot.arms.items()]
        self.upper = np.array(settings.max_velocity)  # that can be asked, and the same to the other sides:
        self.lower = -np.array([settings.max_backward, *settings.max_velocity[1:]])
        self._slew = np.array(settings.acceleration) * robot.dt
        self._phase_step = robot.dt / settings.cycle
        self.cycle_ticks = round(settings.cycle / robot.dt)
        self.phase = np.zeros(shape)
        self.velocity = np.zeros((*shape, 3))
        self.target = np.zeros((*shape, 3))
        self.activity = np.zeros(shape)
        self.lower_by, self.lowered = np.zeros(shape), np.zeros(shape)  # m that are asked, and that it is

    def reset(self, where: Array | slice = slice(None)) -> None:
        """Stand still, in the worlds `where` (default: all)."""
        if self.phase.ndim:
            self.phase[where], self.velocity[where], self.target[where], self.activity[where] = 0.0, 0.0, 0.0, 0.0
            self.lower_by[where], self.lowered[where] = 0.0, 0.0
        else:
            self.phase, self.activity = np.zeros(()), np.zeros(())
            self.velocity, self.target = np.zeros(3), np.zeros(3)
            self.lower_by, self.lowered = np.zeros(()), np.zeros(())

    def command(self, velocity: Array, lower: Array | None = None) -> None:
        """Ask for `(..., 3)` m/s forward, m/s left, rad/s, clipped to the gait's limits, and for a base that is `lower`
        `(...)` m than it goes; None: not at all."""
        self.target = np.clip(velocity, self.lower, self.upper)
        self.lower_by = np.zeros(self.phase.shape) if lower is None else np.asarray(lower, float)

    def advance(self) -> None:
        """Go on by one tick."""
        moving = (np.abs(self.target) > 1e-3).any(-1) | (np.abs(self.velocity) > 1e-3).any(-1)
        self.velocity = self.velocity + np.clip(self.target - self.velocity, -self._slew, self._slew)
        step = _LOWERING * self.robot.dt
        self.lowered = self.lowered + np.clip(self.lower_by - self.lowered, -step, step)
        # Steps fade in over half a cycle and out over a whole one.
        rate = np.where(moving, 2.0, -1.0) * self._phase_step
        # The first step says where it goes: the left foot takes it, but for a walk to the right. Were it drawn, who
        # learns from this could not know what comes, and the mean of a step of either foot is none.
        rightward = _ACROSS * self.target[..., 1] + self.target[..., 2] < 0
        begun = np.where(rightward, 0.5, 0.0)
        self.phase = np.where(self.activity > 0, (self.phase + self._phase_step) % 1.0, begun)
        self.activity = np.clip(self.activity + rate, 0.0, 1.0)

    def led(self, target: Array) -> Array:
        """Joint targets `(..., n_joints)` rad for the gait as it is now, those that turn feet ahead by `yaw_lead`."""
        if not self.settings.yaw_lead:
            return target
        rate = np.clip(self.frames(_NOW).joint_velocity[..., 0, :], -_FASTEST, _FASTEST)
        return target + self.settings.yaw_lead * rate * self._turns

    @property
    def ended(self) -> Array:
        """Never `(...)`."""
        return np.zeros(self.phase.shape, bool)

    def frames(self, ahead: Array) -> ReferenceFrames:
        """Frames `ahead` ticks from now, at the present velocity.

        The root goes the way of the asked twist, leaning, without the sway between steps. Joint velocities are the
        change to the tick after.
        """
        shape = (*self.phase.shape, len(ahead))
        moving = (self.activity > 0)[..., None]
        phase = (self.phase[..., None] + np.asarray(ahead) * self._phase_step * moving) % 1.0
        velocity = np.broadcast_to(self.velocity[..., None, :], (*shape, 3))
        activity = np.broadcast_to(self.activity[..., None], shape)
        lowered = np.broadcast_to(self.lowered[..., None], shape)
        position, contact = self.pose(phase, velocity, activity, lowered)
        after, _ = self.pose((phase + self._phase_step * moving) % 1.0, velocity, activity, lowered)
        height = np.full(shape, self.robot.standing_height)
        seconds = np.asarray(ahead) * self.robot.dt
        # Along an arc: the chord is the arc's length times sin(a) / a, and leaves its start at half of the turn.
        yaw = velocity[..., 2] * seconds
        chord = velocity[..., :2] * (seconds * np.sinc(yaw / (2 * np.pi)))[..., None]
        half = 0.5 * self._lean(velocity[..., 0])
        zero = np.zeros(shape)
        return ReferenceFrames(
            position=position,
            joint_velocity=(after - position) / self.robot.dt,
            velocity=velocity[..., :2],
            yaw_rate=velocity[..., 2],
            height=height,
            root_position=np.concatenate([turned(chord, yaw / 2), height[..., None]], -1),
            root_orientation=headed(joined(np.cos(half), zero, np.sin(half), zero), yaw),
            contact=contact,
        )

    def _lean(self, forward: Array) -> Array:
        """Forward pitch of the base [rad] at `forward` m/s."""
        return self.settings.lean - self.settings.backward_lean * np.minimum(forward, 0.0)

    def pose(self, phase: Array, velocity: Array, activity: Array, lowered: Array | float = 0.0) -> tuple[Array, Array]:
        """Joint positions `(..., n_joints)` and planned contacts `(..., n_feet)` at a phase `(...)` of the cycle.

        A foot swings in the middle of its half of the cycle and is carried back by the body's twist while it stands.
        The base goes `lowered` `(...)` m lower than it walks.
        """
        s = self.settings
        local = (phase[..., None] + self._shift) % 1.0  # 0..0.5 is this foot's step
        swing_share = 0.5 * (1.0 - s.double_support)
        start = 0.25 - swing_share / 2
        u = np.clip((local - start) / swing_share, 0.0, 1.0)  # 0..1 through the swing
        swinging = (u > 0) & (u < 1)
        stance = (local - start - swing_share) % 1.0 / (1.0 - swing_share)  # 0..1 through the stance
        swift = np.interp(velocity[..., 0], s.even_swing, [0.0, 1.0])[..., None]
        even = np.interp(velocity[..., 0], s.even_swing, [1.0, _SMOOTH])[..., None]
        travel = np.where(swinging, -0.5 + u - even * np.sin(2 * np.pi * u) / (2 * np.pi), 0.5 - stance)  # back..front
        lift = np.where(swinging, np.sin(np.pi * u) ** 2, 0.0) * activity[..., None]

        period = (1.0 - swing_share) * s.cycle  # that a foot stands
        vx, vy = velocity[..., None, 0], s.sideways_gain * velocity[..., None, 1]
        wz = s.turning_gain * velocity[..., None, 2]
        backward = np.minimum(vx, 0.0)
        vx = vx + (s.backward_gain - 1.0) * backward
        yaw = wz * period * travel
        down = np.asarray(lowered)[..., None]
        x0, y0 = s.foot_forward + s.lower_shift * down, self._inverse.hip[:, 1] + self._side * s.foot_apart
        x = x0 + s.backward_shift * backward + (vx - wz * y0) * period * travel
        y = y0 + (vy + wz * x0) * period * travel
        y = y + (s.sway * activity * np.sin(2 * np.pi * phase))[..., None]  # away from the foot that steps
        z = self._inverse.hip[:, 2] - (s.height - down) + (s.lift - s.lift_loss * swift) * lift
        lean = self._lean(velocity[..., None, 0])
        cos, sin = np.cos(lean), np.sin(lean)
        ankle = np.stack([cos * x - sin * z, y, sin * x + cos * z], -1)  # seen from the leaning base
        c, n, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
        rotation = np.stack(
            [
                np.stack([cos * c, -cos * n, zero - sin], -1),
                np.stack([n, c, zero], -1),
                np.stack([sin * c, -sin * n, zero + cos], -1),
            ],
            -2,
        )
        legs = self._inverse(ankle, rotation)
        joints = np.broadcast_to(self.robot.home, (*phase.shape, len(self.robot.home))).copy()
        joints[..., self._index] = legs
        swing = s.arm_swing * velocity[..., 0] * np.sin(2 * np.pi * phase) * activity
        for arm, sign in self._arms:
            joints[..., arm] += sign * swing
        contact = np.where(swinging & (activity > 0)[..., None], 0.0, 1.0)
        return joints, contact


class GyroFeedback:
    """Adds to the ankles what the gyro says: the baseline's only balance. An ankle that does not roll, or pitch, cannot
    help."""

    def __init__(self, robot: Robot, settings: GaitSettings | None = None) -> None:
        settings = settings or gait_of(robot)
        legs = Legs(robot)
        self._pitch, self._pitch_sign = legs.turning(robot.home, 1, ankle=True)
        self._roll, self._roll_sign = legs.turning(robot.home, 0, ankle=True)
        self._gains = settings.ankle_pitch_gain, settings.ankle_roll_gain

    def __call__(self, joints: Array, angular_velocity: Array) -> Array:
        """Correct `(..., n_joints)` rad by the base's `(..., 3)` rad/s."""
        out = joints.copy()
        out[..., self._pitch] += self._gains[0] * angular_velocity[..., 1:2] * self._pitch_sign
        out[..., self._roll] += self._gains[1] * angular_velocity[..., 0:1] * self._roll_sign
        return out


def _turning(robot: Robot) -> Array:
    """Legs' joints `(n_joints,)` bool that turn a foot about the vertical at home."""
    legs = Legs(robot)
    axes = legs.forward(legs.pick(robot.home))[3]
    turns = np.zeros(len(robot.joints), bool)
    turns[legs.index[np.abs(axes[..., 2]) > ALONG]] = True
    return turns
