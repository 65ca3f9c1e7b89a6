"""A robot's file drafted from its model: what geometry says of joints, mirrors, feet and the IMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_servo
from servoid.hw.robot.mjcf import compiled, read_spec
from servoid.tools.robots.couplings import Couplings, couplings
from servoid.tools.robots.feet import bottom, find_feet, hip_height

_NEAR = 0.01  # m between a joint and the mirror image of another, and of an axis
_SPAN = 3.0  # rad to either side where the model says no range
_BUS_HEAD = """rate: 50                    # TODO: control ticks a second
bus:
  baud: 1000000             # TODO
  board: none               # TODO: opencr, if there is one
limits:
  joint_speed: {speed:g}        # rad/s a goal may move at
  margin: 0.02              # rad kept from the ends of the ranges
  homing_speed: 0.5         # rad/s
  tilt: 1.047               # rad: beyond it the robot is falling and the guard damps
  stale: {stale}                  # ticks that a sample may be old before the guard damps
  temperature: {hot:g}           # degrees C at which the robot is lowered
imu:                        # TODO: its kind and its port; with none the robot cannot balance
  kind: none
  gyro_noise: 0.003         # rad/s, standard deviation of a sample
  gyro_bias: 0.02           # rad/s, half-width at power-on
  accelerometer_noise: 0.1  # m/s2
  accelerometer_bias: 0.1   # m/s2
  average: 0.010            # s
  latency: 0.010            # s
"""


@dataclass(frozen=True)
class Choices:
    """What a person chose, where the model leaves a choice."""

    servo: str
    base: str | None
    imu: str | None


@dataclass(frozen=True)
class DraftedJoint:
    """A joint: range and home [rad], and the joint on the other side with the sign that a pose takes there."""

    name: str
    range: tuple[float, float]
    home: float
    mirror: str
    sign: int
    gear: float = 1.0


@dataclass(frozen=True)
class Draft:
    """What was found. `feet` are geoms by the name of their foot."""

    model: Path
    base: str
    imu: str
    servo: str
    feet: dict[str, tuple[str, ...]]
    joints: tuple[DraftedJoint, ...]
    passive: tuple[str, ...]
    held: tuple[str, ...]
    overlapping: tuple[tuple[str, str], ...]  # bodies that are drawn into each other
    origin: tuple[float, float, float]  # m, of the base in its body: the model's own may be on the ground
    posed: bool  # whether the model has a home pose, as a keyframe
    notes: tuple[str, ...]

    def at_home(self, pose: Array) -> Draft:
        """The same with another home pose `(n_joints,)` rad."""
        joints = (replace(joint, home=round(float(at), 4) + 0.0) for joint, at in zip(self.joints, pose, strict=True))
        return replace(self, joints=tuple(joints))

    def text(self, out: Path) -> str:
        """The robot's file, which is to be at `out`."""
        servo, model = load_servo(self.servo), self.model.resolve()
        gear = max(j.gear for j in self.joints)
        path = model.name if model.parent == out.parent.resolve() else str(model)
        rows = [
            f"  - {{name: {j.name}, servo: {self.servo}, id: {i + 1}, direction: 1, zero: 0.0, "
            f"range: [{j.range[0]:.4f}, {j.range[1]:.4f}], home: {j.home:.4f}, "
            f"mirror: {j.mirror}, mirror_sign: {j.sign}{f', gear: {j.gear:.6g}' if j.gear != 1.0 else ''}}}"
            for i, j in enumerate(self.joints)
        ]
        feet = [f"  {name}: {{geoms: [{', '.join(geoms)}]}}" for name, geoms in self.feet.items()]
        limits = _BUS_HEAD.format(speed=0.95 * servo.no_load_speed / gear, stale=3, hot=servo.max_temperature - 10)
        origin = f"origin: [{', '.join(f'{x:.4f}' for x in self.origin)}]\n" if any(self.origin) else ""
        passive = f"passive: [{', '.join(self.passive)}]\n" if self.passive else ""
        pairs = "".join(f"  - [{one}, {other}]\n" for one, other in self.overlapping)
        passive += f"overlapping: # bodies that the model draws into each other\n{pairs}" if pairs else ""
        passive += f"held: [{', '.join(self.held)}]\n" if self.held else ""
        return (
            f"# {out.stem}: drafted by `servoid robot import`. TODO marks what its model does not say.\n"
            f"name: {out.stem.replace(' ', '-')}\nmjcf: {path}\nbase: {self.base}\n{origin}imu_site: {self.imu}\n"
            f"{limits}{passive}feet:\n"
            + "\n".join(feet)
            + "\njoints: # TODO: servo, id, direction and zero of each\n"
            + "\n".join(rows)
            + "\n"
        )


def draft(path: Path, choices: Choices) -> Draft:
    """Raises ConfigError for a model that is no humanoid's, with what is missing."""
    load_servo(choices.servo)
    spec = read_spec(path, choices.base)
    for key in spec.keys:
        key.ctrl = []  # of which only the pose is read, whatever motors it was written for
    if spec.meshes:
        compiled(spec, path)  # says which are missing
    model = compiled(spec, path)
    base = _base(model, choices.base, path)
    notes = ["servo, id, direction and zero of every joint", "bus, rate and imu"]
    inside = [b for b in range(model.nbody) if model.body_rootid[b] == model.body_rootid[base]]
    ties = couplings(model, path)
    horns = [horn for horn, _ in ties.gears.values()]
    hinges = [j for j in range(model.njnt) if model.jnt_bodyid[j] in inside and model.jnt_type[j] != _FREE]
    held = [j for j in hinges if model.joint(j).name in (*horns, *ties.tangled)]
    moved = {*ties.followers, *ties.looped} - set(ties.gears)
    passive = [
        j
        for j in hinges
        if j not in held and (model.joint(j).name in moved or model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE)
    ]
    joints = [j for j in hinges if j not in (*passive, *held)]
    if not joints:
        raise ConfigError(f"{path}: no hinge below body {model.body(base).name!r}")
    if passive:
        notes.append(f"passive joints, which no servo is taken to drive: {_names(model, passive)}")
    for limb, (horn, gear) in ties.gears.items():
        notes.append(f"{limb}: {horn} turns it, {gear:.4g} turns for one: the ID and direction are of that servo")
    if ties.tangled:
        notes.append(
            f"{', '.join(ties.tangled)}: tendons tie several of them to several, as in a differential, which no gear "
            "of one servo says; they are held at 0, so their servos must hold them there"
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turn = data.xmat[base].reshape(3, 3)
    places, axes = (data.xanchor - data.xpos[base]) @ turn, data.xaxis @ turn
    feet = find_feet(model, data, base, inside)
    if len(feet) != 2:
        raise ConfigError(
            f"{path}: {len(feet)} feet found where two are needed: collision geoms at the ends of limbs, at the lowest "
            "point, left and right; without them write the robot's file by hand"
        )
    imu = choices.imu or _imu(model, base, notes)
    drafted = _mutual([_geared(model, _joint(model, j, joints, places, axes, notes), ties) for j in joints], notes)
    if loose := [model.joint(j).name for j in joints if not model.jnt_limited[j]]:
        notes.append(f"range of {', '.join(loose)}: the model has none")
    up = turn[:, 2]
    soles = min(bottom(model, data, model.geom(geom).id, base, up) for geoms in feet.values() for geom in geoms)
    bodies = [int(model.geom(geoms[0]).bodyid[0]) for geoms in feet.values()]
    top = float(np.mean([hip_height(model, data, body, base) for body in bodies]))
    # Of an origin that is not well above the soles, a height says little of whether the robot has fallen.
    origin = (0.0, 0.0, round(top, 4)) if -soles < 0.5 * (top - soles) else (0.0, 0.0, 0.0)
    return Draft(
        model=path,
        base=model.body(base).name,
        imu=imu,
        servo=choices.servo,
        feet=feet,
        joints=drafted,
        passive=tuple(_each(model, passive)),
        held=tuple(_each(model, held)),
        overlapping=(),
        origin=origin,
        posed=bool(model.nkey),
        notes=tuple(notes),
    )


_FREE = mujoco.mjtJoint.mjJNT_FREE


def _each(model: mujoco.MjModel, joints: Sequence[int]) -> list[str]:
    return [model.joint(j).name for j in joints]


def _names(model: mujoco.MjModel, joints: Sequence[int]) -> str:
    return ", ".join(_each(model, joints))


def _base(model: mujoco.MjModel, wanted: str | None, path: Path) -> int:
    """The free body with the most bodies on it, or the one that was named."""
    free = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == _FREE]
    names = {model.body(b).name: b for b in free}
    if wanted is not None and wanted not in names:
        raise ConfigError(f"--base {wanted}: no body of that name with a free joint; {nearest(wanted, names)}")
    if not free:
        raise ConfigError(f"{path}: no body has a free joint: give the robot's base <freejoint/> in the MJCF")
    return names[wanted] if wanted is not None else max(free, key=lambda b: int((model.body_rootid == b).sum()))


def _imu(model: mujoco.MjModel, base: int, notes: list[str]) -> str:
    sites = [model.site(s) for s in range(model.nsite) if model.body_rootid[model.site_bodyid[s]] == base]
    named = [site for site in sites if "imu" in site.name.lower() or "gyro" in site.name.lower()]
    here = [site.name for site in named or sites if model.body_weldid[site.bodyid[0]] == base]
    chosen = next(iter(here), "")
    if named and not chosen:
        body = model.body(int(named[0].bodyid[0])).name
        raise ConfigError(
            f"the IMU's site {named[0].name!r} is on body {body!r}, which moves against {model.body(base).name!r}: "
            f"give --base {body}, and the robot hangs on that one"
        )
    if not chosen:
        raise ConfigError(
            f'no site on the base {model.body(base).name!r}: add <site name="imu"/> to that body where the IMU sits'
        )
    if not named:
        notes.append(f"imu_site: {chosen} is only a guess")
    return chosen


def _joint(
    model: mujoco.MjModel, joint: int, joints: Sequence[int], places: Array, axes: Array, notes: list[str]
) -> DraftedJoint:
    """A joint with its mirror: the one at its image in the base's x-z plane, about the image of its axis."""
    name, flip = model.joint(joint).name, np.array([1.0, -1.0, 1.0])
    apart = [places[other] - flip * places[joint] for other in joints]
    away = np.linalg.norm(apart, axis=-1)
    # Where along its axis a joint's point is does not matter.
    beside = np.array([np.linalg.norm(np.cross(one, axes[other])) for one, other in zip(apart, joints, strict=True)])
    # A turn is seen in the mirror about the image of its axis, the other way round.
    along = np.array([float(-(flip * axes[joint]) @ axes[other]) for other in joints])
    fits = np.flatnonzero((beside < _NEAR) & (np.abs(along) > 0.99))
    best = int(fits[away[fits].argmin()]) if len(fits) else joints.index(joint)
    if not len(fits):
        notes.append(f"mirror of {name}: no joint is at its place on the other side")
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-_SPAN, _SPAN)
    low, high = max(float(low), -_SPAN), min(float(high), _SPAN)
    key = float(model.key_qpos[0, model.jnt_qposadr[joint]]) if model.nkey else 0.0
    sign = 1 if not len(fits) or along[best] > 0 else -1
    return DraftedJoint(name, (low, high), float(np.clip(key, low, high)), model.joint(joints[best]).name, sign)


def _geared(model: mujoco.MjModel, joint: DraftedJoint, ties: Couplings) -> DraftedJoint:
    """The joint with its gear, and within the range of its horn."""
    if joint.name not in ties.gears:
        return joint
    horn, gear = ties.gears[joint.name]
    low, high = joint.range
    if model.joint(horn).limited[0]:
        room = float(np.abs(model.joint(horn).range).min()) / gear
        low, high = max(low, -room), min(high, room)
    return replace(joint, gear=gear, range=(low, high), home=float(np.clip(joint.home, low, high)))


def _mutual(drafted: Sequence[DraftedJoint], notes: list[str]) -> tuple[DraftedJoint, ...]:
    """The joints, each its own mirror where the one at its image is the image of another: of two in a line across the
    robot's middle, say, of which only one is on it."""
    mirrors = {joint.name: joint.mirror for joint in drafted}
    alone = {name for name, mirror in mirrors.items() if mirrors[mirror] != name}
    notes.extend(f"mirror of {name}: {mirrors[name]}, at its image, is that of another" for name in sorted(alone))
    return tuple(replace(joint, mirror=joint.name, sign=1) if joint.name in alone else joint for joint in drafted)
