"""What a robot's file leaves to its MJCF: the chains of its legs, its soles and the height that it stands at.

A chain runs from the base to the body of a foot, over bodies that are fixed to each other and over joints that legs
share, such as a waist. Its links are described in axes that are the base's at zero angles, so that a link's frame does
not matter, however it is turned in the file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import Marks, nearest
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix
from servoid.hw.robot.mjcf import compiled, read_body
from servoid.hw.robot.soles import find_sole

if TYPE_CHECKING:
    import mujoco

    from servoid.hw.robot.description import Axes, Foot, Link, Robot

_ALIKE = 1e-4  # m: a chain that the robot's file gives, too, must be the MJCF's so far
_PITCHES = 0.7  # of an axis: its part along the base's y
_ASTRAY = 0.01  # m that a given sole may lie beside the foot's geoms


@dataclass(frozen=True)
class _Chain:
    """Joints from the base to a foot's body, and that body `(3,)`, `(3, 3)` in the frame of the last of them."""

    joints: tuple[str, ...]
    offsets: Array  # (joints, 3) m, from the joint before
    axes: Array  # (joints, 3)
    place: Array
    turn: Array


def with_body(robot: Robot, marks: Marks) -> Robot:
    """The robot with legs, soles and standing height read from its MJCF, whose path is absolute by now.

    Raises ConfigError, also where the file says otherwise than the MJCF.
    """
    from servoid.hw.robot.legs import Legs

    model = _kinematic_model(robot)
    _check_imu(model, robot, marks)
    legs: dict[str, tuple[Link, ...]] = {}
    feet: dict[str, Foot] = {}
    for side in robot.feet:
        chain = _chain(model, robot, side, marks)
        legs[side] = _links(chain)
        feet[side] = _placed(model, robot, side, chain, marks)
        if len(legs[side]) != len(next(iter(legs.values()))):
            raise marks.error(
                f"feet.{side}",
                f"{len(legs[side])} joints lead to it ({', '.join(chain.joints)}), to the first foot "
                f"{len(next(iter(legs.values())))}: legs need the same number of joints",
            )
    _check_given(robot, legs, marks)
    robot = replace(robot, legs=legs, feet=feet, arms=_arms(model, robot, legs))
    if np.isnan(robot.standing_height):
        height = float(Legs(robot).stand(robot.home)[0])
        if height <= 0:
            raise marks.error(
                "base",
                f"the frame of body {robot.base!r} is {-height:.3f} m below the soles at home: how high the base is "
                "tells whether the robot has fallen, so its origin must be in the trunk: give that as `origin`",
            )
        robot = replace(robot, standing_height=height)
    return robot


def _kinematic_model(robot: Robot) -> mujoco.MjModel:
    """The compiled model without what does not matter to kinematics, which may be slow to load."""
    import mujoco

    spec = read_body(robot)
    wanted = {name for foot in robot.feet.values() for name in foot.geoms}
    for element in [*spec.actuators, *spec.sensors, *spec.keys, *spec.equalities, *spec.tendons, *spec.excludes]:
        spec.delete(element)
    shapes = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF
    for geom in list(spec.geoms):
        if geom.name not in wanted and geom.type in shapes:
            spec.delete(geom)
        else:
            geom.material = ""
    kept = {geom.meshname for geom in spec.geoms}
    for element in [*spec.materials, *spec.textures, *spec.hfields, *(m for m in spec.meshes if m.name not in kept)]:
        spec.delete(element)
    spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6  # a body whose geoms are gone has no mass of its own
    return compiled(spec, robot.mjcf)


def _chain(model: mujoco.MjModel, robot: Robot, side: str, marks: Marks) -> _Chain:
    import mujoco

    key = f"feet.{side}.geoms"
    bodies = [int(model.geom(name).bodyid[0]) for name in robot.feet[side].geoms]
    if len({int(model.body_weldid[body]) for body in bodies}) > 1:
        raise marks.error(key, "the geoms are on bodies that move against each other: a foot is one body")
    chain = _walk(model, int(model.body(robot.base).id), bodies[0])
    for name in chain.joints:
        if int(model.joint(name).type[0]) != mujoco.mjtJoint.mjJNT_HINGE:
            raise marks.error(key, f"{name!r}, on the way from the base to it, is not a hinge, but a servo turns")
        if name not in robot.names:
            raise marks.error(
                key,
                f"{name!r}, on the way from the base to it, has no servo: its angle is not known. Where a servo "
                "turns it by gears, list it with its `gear`, and the servo's own joint under `held`",
            )
    if not chain.joints:
        raise marks.error(key, f"no joint leads from the base {robot.base!r} to this foot")
    return chain


def _walk(model: mujoco.MjModel, base: int, end: int) -> _Chain:
    """The chain from the base to any body that hangs on it."""
    path: list[int] = []
    while end != base:
        path.insert(0, end)
        end = int(model.body_parentid[end])
    place, turn = np.zeros(3), np.eye(3)
    joints, offsets, axes = [], [], []
    for body in path:
        place = place + turn @ model.body_pos[body]
        turn = turn @ rotation_matrix(model.body_quat[body])
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            joints.append(model.joint(j).name)
            offsets.append(place + turn @ model.jnt_pos[j])
            axes.append(turn @ model.jnt_axis[j])
            place = place - offsets[-1]
    return _Chain(tuple(joints), np.array(offsets), np.array(axes), place, turn)


def _arms(model: mujoco.MjModel, robot: Robot, legs: dict[str, tuple[Link, ...]]) -> dict[str, float]:
    """Joints that swing an arm, in no leg and with another in the mirror: of each arm the first that pitches; and the
    sign by which it swings the left arm back and the right one forward."""
    in_legs = {link.joint for leg in legs.values() for link in leg}
    base, found = int(model.body(robot.base).id), dict[str, float]()
    for joint in robot.joints:
        if joint.name in in_legs or joint.mirror == joint.name:
            continue
        chain = _walk(model, base, int(model.jnt_bodyid[model.joint(joint.name).id]))
        last = chain.joints.index(joint.name)
        pitches = [name for name, axis in zip(chain.joints, chain.axes, strict=True) if abs(axis[1]) > _PITCHES]
        if pitches[:1] == [joint.name]:
            side = np.sign(chain.offsets[: last + 1, 1].sum())
            found[joint.name] = float(side * np.sign(chain.axes[last, 1]))
    return found


def _check_imu(model: mujoco.MjModel, robot: Robot, marks: Marks) -> None:
    """The IMU moves with the base, whose angular velocity it measures."""
    on = int(model.body_weldid[model.site(robot.imu_site).bodyid[0]])
    if on != model.body(robot.base).id:
        raise marks.error(
            "imu_site",
            f"{robot.imu_site!r} is on body {model.body(on).name!r}, which moves against the base {robot.base!r}: "
            "name that body as the base, from which the robot hangs then, or a site on the base",
        )


def _links(chain: _Chain) -> tuple[Link, ...]:
    from servoid.hw.robot.description import Link

    rows = zip(chain.joints, chain.offsets.tolist(), chain.axes.tolist(), strict=True)
    return tuple(Link(joint, tuple(offset), tuple(axis)) for joint, offset, axis in rows)


def _placed(model: mujoco.MjModel, robot: Robot, side: str, chain: _Chain, marks: Marks) -> Foot:
    """The foot with its sole found, or, where its file gives that, checked."""
    foot = robot.feet[side]
    found = find_sole(model, foot.geoms, _at(robot, chain) @ chain.turn)
    sole = np.where(np.isnan(foot.sole), found.centre, foot.sole)
    half = np.where(np.isnan(foot.half_size), found.half_size, foot.half_size)
    away = np.linalg.norm(sole - found.centre)
    if away > _ASTRAY + np.hypot(*found.half_size) or abs((sole - found.centre) @ found.turn[:, 2]) > _ASTRAY:
        body = model.body(int(model.geom(foot.geoms[0]).bodyid[0])).name
        raise marks.error(
            f"feet.{side}.sole",
            f"is {1000 * away:.0f} mm from the sole of {', '.join(foot.geoms)}, which in the frame of body {body!r} is "
            f"at [{', '.join(f'{x:.4f}' for x in found.centre)}]; leave `sole` and `half_size` out to have them read",
        )
    return replace(
        foot,
        sole=tuple(sole.tolist()),
        half_size=tuple(half.tolist()),
        axes=_rows(found.turn),
        body_place=tuple(chain.place.tolist()),
        body_axes=_rows(chain.turn),
    )


def _rows(turn: Array) -> Axes:
    (a, b, c), (d, e, f), (g, h, i) = turn.tolist()
    return (a, b, c), (d, e, f), (g, h, i)


def _at(robot: Robot, chain: _Chain) -> Array:
    """Rotation of the last joint's frame at the home pose."""
    from servoid.hw.robot.legs import rotations

    angles = [robot.joints[robot.names.index(name)].home for name in chain.joints]
    turn = np.eye(3)
    for step in rotations(np.array(angles), chain.axes):
        turn = turn @ step
    return turn


def _check_given(robot: Robot, found: dict[str, tuple[Link, ...]], marks: Marks) -> None:
    """Where the robot's file describes legs, too, they are those of the MJCF."""
    for side, leg in robot.legs.items():
        if side not in found:
            raise marks.error(f"legs.{side}", f"no foot of that name; {nearest(side, found)}")
        theirs = found[side]
        if [link.joint for link in leg] != [link.joint for link in theirs]:
            raise marks.error(
                f"legs.{side}",
                f"the joints that lead to this foot in {robot.mjcf} are {', '.join(link.joint for link in theirs)}; "
                "leave `legs` out to have them read",
            )
        for i, (ours, real) in enumerate(zip(leg, theirs, strict=True)):
            away = np.abs(np.subtract(ours.offset, real.offset)).max()
            turned = np.abs(np.subtract(ours.axis, real.axis)).max()
            if away > _ALIKE or turned > 1e-3:
                raise marks.error(
                    f"legs.{side}[{i}]",
                    f"{ours.joint}: its offset is {1000 * away:.1f} mm, its axis {turned:.3f} beside those of "
                    f"{robot.mjcf}; leave `legs` out to have them read",
                )
