"""What of a robot's file can be held against its model, each a finding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.hw.robot.mjcf import compiled, read_spec
from servoid.policy.references.gait import Gait
from servoid.sim.model import build
from servoid.tools.robots.couplings import couplings
from servoid.tools.robots.facts import Comparison, file_findings

_POSES = 50
_EXACT = 1e-6  # m
_TOUCHING = 1e-4  # m that shapes may overlap
_SAME_GEAR = 1e-3  # of a ratio
_MIRRORED = 0.005  # m that joints may be beside their mirror images
_LOPSIDED = 0.015  # m more that a body's centre of mass may be: no robot is quite alike on both sides
_LOADED = 0.6  # share of its stall torque that a servo may need to hold the robot at home
_LEVEL = 0.05  # rad that soles may lean against each other at home
_UPRIGHT = 0.15  # rad that the base may lean at home
_STIFF = 1.5  # times the stiffness at which a robot topples at home by its weight alone
_RAISED = 3.0  # times that a servo's P gain can be raised by: beyond, only a stronger one holds the robot
_WHIP = 4.0  # times the speed that a goal may have, that the gait's joints may ask for: servos lag behind


def findings(robot: Robot) -> list[Comparison]:
    """All comparisons. Raises ConfigError where the robot cannot be simulated at all."""
    model = build(robot)
    data = mujoco.MjData(model)
    joints = np.array([int(model.joint(name).qposadr[0]) for name in robot.names])
    mass = float(model.body_mass[1:].sum())
    found = [
        Comparison(
            True, "weight and height", f"{mass:.2f} kg, base {robot.standing_height:.3f} m above the ground at home"
        ),
        *file_findings(robot),
        _kinematics(robot, model, data, joints),
        *_gears(robot),
        _apart(robot, model),
        _mirrors(robot, model, data, joints),
        _ranges(robot),
        _soles(robot),
        _upright(robot),
        _balance(robot, model, data, joints),
        _load(robot, model, data, joints),
        _stiffness(robot, model, data, joints),
        steps(robot),
    ]
    _put(model, data, joints, robot.home)
    at = {name: data.xanchor[model.joint(name).id].copy() for name in robot.names}
    return [replace(one, places=one.places + _places(*(at[name] for name in one.joints))) for one in found]


def _places(*points: Array) -> tuple[tuple[float, float, float], ...]:
    """Points `(3,)` as plain figures, to the millimetre."""
    return tuple((round(float(x), 3), round(float(y), 3), round(float(z), 3)) for x, y, z in points)


def _put(model: mujoco.MjModel, data: mujoco.MjData, joints: Array, pose: Array) -> None:
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    data.qpos[joints] = pose
    mujoco.mj_fwdPosition(model, data)


def _kinematics(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, joints: Array) -> Comparison:
    legs, rng, worst = Legs(robot), np.random.default_rng(0), 0.0
    for pose in rng.uniform(robot.lower, robot.upper, (_POSES, len(joints))):
        _put(model, data, joints, pose)
        mujoco.mj_sensorPos(model, data)
        soles, _ = legs.soles(legs.pick(pose))
        for sole, foot in zip(soles, robot.legs, strict=True):
            worst = max(worst, float(np.abs(data.sensor(f"servoid/{foot}_position").data - sole).max()))
    text, at_home = f"soles {worst:.1e} m from MuJoCo's at {_POSES} random poses", legs.soles(legs.pick(robot.home))[0]
    return Comparison(worst < _EXACT, "kinematics", text, places=_places(*at_home) if worst >= _EXACT else ())


def _gears(robot: Robot) -> list[Comparison]:
    """Joints whose horn is a joint of the model have the ratio of the two."""
    if not robot.held:
        return []
    path = Path(robot.mjcf)
    ties = couplings(compiled(read_spec(path, robot.base), path), path).gears
    wrong = [
        f"{joint.name} {joint.gear:g}, by the model {ties[joint.name][1]:g}"
        for joint in robot.joints
        if joint.name in ties and abs(joint.gear / ties[joint.name][1] - 1.0) > _SAME_GEAR
    ]
    return [Comparison(not wrong, "gears", "; ".join(wrong) or "as the model ties joints to their servos' horns")]


def overlaps(robot: Robot, model: mujoco.MjModel) -> dict[tuple[str, str], tuple[float, Array]]:
    """Pairs of the robot's bodies whose shapes overlap at home, as they collide: by how much [m], and where `(3,)` m in
    the base's frame."""
    data, found = mujoco.MjData(model), dict[tuple[str, str], tuple[float, Array]]()
    _put(model, data, np.array([int(model.joint(name).qposadr[0]) for name in robot.names]), robot.home)
    for contact in data.contact:
        bodies = (int(model.geom_bodyid[geom]) for geom in contact.geom)
        first, second = sorted(model.body(body).name for body in bodies)
        if "world" not in (first, second) and contact.dist < -_TOUCHING:
            before = found.get((first, second), (0.0, contact.pos))
            found[first, second] = max(before, (-float(contact.dist), contact.pos.copy()), key=lambda one: one[0])
    return found


def _apart(robot: Robot, model: mujoco.MjModel) -> Comparison:
    """No limbs push each other away at home."""
    found = overlaps(robot, model)
    wrong = [f"{one} and {other} by {1000 * by:.0f} mm" for (one, other), (by, _) in found.items()]
    hint = ": they push each other away; move them apart in the model, or name them as `overlapping`"
    text = f"overlap: {', '.join(wrong)}{hint}" if wrong else "apart from each other"
    return Comparison(not wrong, "limbs at home", text, places=_places(*(place for _, place in found.values())))


def _mirrors(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, joints: Array) -> Comparison:
    """Joints of a mirrored pose are at the mirror images of where they were."""
    index, sign = robot.mirror
    ids, flip = [model.joint(name).id for name in robot.names], np.array([1.0, -1.0, 1.0])
    pose = robot.home + 0.3 * np.random.default_rng(1).uniform(-1.0, 1.0, len(joints)) * (robot.upper - robot.lower) / 2
    _put(model, data, joints, pose)
    bodies = model.jnt_bodyid[ids]
    here, masses = data.xanchor[ids].copy(), data.xipos[bodies].copy()
    _put(model, data, joints, pose[index] * sign)
    apart, axes = data.xanchor[ids] - here[index] * flip, data.xaxis[ids]
    away = np.linalg.norm(np.cross(apart, axes), axis=-1)  # where along its axis a joint's point is does not matter
    off = np.linalg.norm(data.xipos[bodies] - masses[index] * flip, axis=-1) - _LOPSIDED
    away = np.maximum(away, off)
    worst = int(away.argmax())
    text = f"joints {1000 * away.max():.1f} mm beside their images, most {robot.names[worst]}"
    wrong = tuple(robot.names[i] for i in np.flatnonzero(away >= _MIRRORED))
    return Comparison(not wrong, "mirrors", text, wrong)


def _ranges(robot: Robot) -> Comparison:
    """Both sides may go as far."""
    index, sign = robot.mirror
    ends = np.sort(np.stack([robot.lower[index] * sign, robot.upper[index] * sign]), axis=0)
    off = np.abs(ends - np.stack([robot.lower, robot.upper])).max(0)
    off[index == np.arange(len(index))] = 0.0
    wrong = [robot.names[i] for i in np.flatnonzero(off > 1e-3)]
    text = f"differ from their mirrors': {', '.join(wrong)}" if wrong else "alike on both sides"
    return Comparison(not wrong, "ranges", text, tuple(wrong))


def _soles(robot: Robot) -> Comparison:
    legs = Legs(robot)
    _, rotation, _, _ = legs.forward(legs.pick(robot.home))
    tilt = float(np.arccos(np.clip(rotation[:, :, 2] @ rotation[0, :, 2], -1.0, 1.0)).max())
    soles, corners = legs.soles(legs.pick(robot.home))
    step = float(np.ptp(corners @ rotation[0, :, 2]))
    text = f"{tilt:.3f} rad and {1000 * step:.0f} mm from one plane"
    return Comparison(tilt < _LEVEL, "soles at home", text, places=_places(*soles) if tilt >= _LEVEL else ())


def _upright(robot: Robot) -> Comparison:
    """With its soles on the ground, the base stands upright at home."""
    up = rotation_matrix(Legs(robot).stand(robot.home)[1])[2]  # the vertical, in the base's frame
    lean, ahead = float(np.arccos(np.clip(up[2], -1.0, 1.0))), -up[0]
    if lean < _UPRIGHT:
        return Comparison(True, "trunk at home", f"leans {lean:.3f} rad with the soles on the ground")
    way = "ahead" if ahead > abs(up[1]) else "back" if -ahead > abs(up[1]) else "aside"
    hint = "the soles are turned that far: turn ankles or hips at home so that they are level under an upright trunk"
    return Comparison(False, "trunk at home", f"leans {way} by {lean:.3f} rad with the soles on the ground: {hint}")


def _balance(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, joints: Array) -> Comparison:
    """The centre of mass is above the soles at home."""
    legs = Legs(robot)
    _put(model, data, joints, robot.home)
    mujoco.mj_comPos(model, data)
    _, rotation, _, _ = legs.forward(legs.pick(robot.home))
    corners = legs.soles(legs.pick(robot.home))[1].reshape(-1, 3) @ rotation[0]
    centre = data.subtree_com[model.body(robot.base).id] @ rotation[0]
    room = float(min(centre[0] - corners[:, 0].min(), corners[:, 0].max() - centre[0]))
    text = f"the centre of mass is {1000 * room:.0f} mm inside the soles' ends"
    ground = np.array([*centre[:2], corners[:, 2].min()]) @ rotation[0].T
    return Comparison(room > 0, "balance at home", text, places=() if room > 0 else _places(ground))


def _load(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, joints: Array) -> Comparison:
    """What holding each leg's share of the weight at home takes of the servos."""
    legs = Legs(robot)
    _put(model, data, joints, robot.home)
    mujoco.mj_comPos(model, data)
    q = legs.pick(robot.home)
    _, rotation, origins, axes = legs.forward(q)
    up = rotation[0, :, 2]
    soles, _ = legs.soles(q)
    centre = data.subtree_com[model.body(robot.base).id]
    under = soles + (centre - soles.mean(0)) - up * ((centre - soles.mean(0)) @ up)  # where the ground carries
    weight = 9.81 * float(model.body_mass[1:].sum()) / len(soles)
    torque = np.abs((np.cross(axes, under[:, None] - origins) @ up) * weight)
    stall = np.array([servo.stall_torque for servo in robot.servos])[legs.index]
    leg, joint = np.unravel_index(int((torque / stall).argmax()), torque.shape)
    share = float((torque / stall)[leg, joint])
    name = robot.names[legs.index[leg, joint]]
    good = share < _LOADED
    text = f"{name} needs most: {100 * share:.0f} % of its stall torque{'' if good else ': give it a stronger servo'}"
    return Comparison(good, "servos at home", text, () if good else (name,))


def _stiffness(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, joints: Array) -> Comparison:
    """How far the servos' springs are from those on which the robot topples forward, as an inverted pendulum does.

    Over the joints that pitch, both legs alike and the feet on the ground, the potential energy has the Hessian K + G,
    of springs and weight. It stands while that is positive: of K alone the least share that is enough is an eigenvalue.
    """
    legs, (index, sign) = Legs(robot), robot.mirror
    _, rotation, _, axes = legs.forward(legs.pick(robot.home))
    pitching = [int(legs.index[0, j]) for j in np.flatnonzero(np.abs(axes[0] @ rotation[0, :, 1]) > 0.7)]
    base, weight = model.body(robot.base).id, 9.81 * float(model.body_mass[1:].sum())

    def energy(bend: Array) -> float:
        pose = robot.home.copy()
        pose[pitching] += bend
        image = [int(index[joint]) for joint in pitching]
        pose[image] = pose[pitching] * sign[pitching]
        _put(model, data, joints, pose)
        mujoco.mj_comPos(model, data)
        _, rotation, _, _ = legs.forward(legs.pick(pose))
        soles, _ = legs.soles(legs.pick(pose))
        return weight * float((data.subtree_com[base] - soles[0]) @ rotation[0, :, 2])

    n, step = len(pitching), 0.02 * np.eye(len(pitching))
    curved = [[energy(a + b) - energy(a - b) - energy(b - a) + energy(-a - b) for a in step] for b in step]
    root = np.sqrt(2.0 * np.array([robot.servos[joint].stiffness for joint in pitching]))  # two legs
    share = np.linalg.eigvalsh(-np.array(curved).reshape(n, n) / (4 * 0.02**2) / np.outer(root, root)).max(initial=0.0)
    times = 1.0 / max(float(share), 1e-3)
    good = times > _STIFF
    more = np.ceil(10.0 * _STIFF / times) / 10.0
    remedy = (
        f"raise the servos' P gain {more:.1f} times, and their stiffness too" if more < _RAISED else "stronger servos"
    )
    hint = "" if good else f": it sinks and topples; {remedy}"
    return Comparison(good, "stiffness at home", f"{times:.1f} times what it takes to stand{hint}")


def steps(robot: Robot) -> Comparison:
    """The gait's steps are within the joints' ranges."""
    gait, phase = Gait(robot), np.linspace(0.0, 1.0, 24, endpoint=False)
    velocity = np.broadcast_to(np.array([0.5, 0.0, 0.0]) * gait.upper, (24, 3))
    pose, _ = gait.pose(phase, velocity, np.ones(24))
    margin = robot.limits.margin - 1e-9
    beyond = ((pose < robot.lower + margin) | (pose > robot.upper - margin)).any(0)
    legs = set(Legs(robot).index.ravel().tolist())  # others may rest at an end, and are held off it
    wrong = [name for i, name in enumerate(robot.names) if np.asarray(beyond)[i] and i in legs]
    speed = float(np.abs(np.diff(pose, axis=0, append=pose[:1])).max() * 24 / gait.settings.cycle)
    most = _WHIP * robot.limits.joint_speed
    fast = speed > most
    text = (
        f"beyond the ranges of {', '.join(wrong)}"
        if wrong
        else f"within the ranges, joints up to {speed:.1f} of {most:.1f} rad/s"
    )
    hint = (
        ": no servo follows; bend the knees at home, or search for other steps with servoid tune gait" if fast else ""
    )
    return Comparison(not (wrong or fast), "steps of the gait", text + hint, tuple(wrong))
