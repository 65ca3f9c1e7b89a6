"""A model that hangs on another body than the one that its file begins with.

Where the IMU is on a body that moves against the file's first one, a torso on a pelvis say, that body is the robot's
base: the bodies between the two are turned round, each hanging on the one that hung on it.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix

if TYPE_CHECKING:
    import mujoco

_FOLDERS = ("meshdir", "texturedir", "assetdir")


def rerooted(spec: mujoco.MjSpec, base: str, path: Path) -> mujoco.MjSpec:
    """The model with `base` as a child of the world, where the first body above it has a free joint; numbers have the
    six digits that MuJoCo writes. Raises ValueError where it cannot compile the model."""
    import mujoco

    top = spec.body(base)
    while top is not None and top.parent.name != "world":
        top = top.parent
    if top is None or top.name == base or all(joint.type != mujoco.mjtJoint.mjJNT_FREE for joint in top.joints):
        return spec
    before = spec.compile()
    root = ElementTree.fromstring(spec.to_xml())
    compiler = root.find("compiler")
    if compiler is not None:
        for folder in _FOLDERS:
            compiler.set(folder, str((path.parent / compiler.get(folder, "")).resolve()))
    chain = _chain(root, base)
    free = [part for part in chain[0] if part.tag == "freejoint" or part.get("type") == "free"]
    _inherit(chain)
    for part in free:
        chain[0].remove(part)
    for above, below in itertools.pairwise(chain):
        _turn_round(above, below)
    world = root.find("worldbody")
    assert world is not None
    world.remove(chain[0])
    for above, below in itertools.pairwise(chain):
        above.remove(below)
    for above, below in itertools.pairwise(chain):
        below.append(above)
    world.append(chain[-1])
    for part in reversed(free):
        chain[-1].insert(0, part)
    result = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    if before.nkey:
        after = result.compile()
        for number, key in enumerate(result.keys):
            key.qpos = _pose(before, number, after)
    return result


def _pose(before: mujoco.MjModel, number: int, after: mujoco.MjModel) -> Array:
    """The joints of a keyframe in their new order `(nq,)`; where the base is, they do not say."""
    pose: Array = after.qpos0.copy()
    for joint in (after.joint(i) for i in range(after.njnt)):
        if len(joint.qpos0) == 1:
            pose[joint.qposadr[0]] = before.key_qpos[number, before.joint(joint.name).qposadr[0]]
    return pose


def _chain(root: ElementTree.Element, base: str) -> list[ElementTree.Element]:
    """The bodies from the world's child to the one of that name."""
    parents = {child: parent for parent in root.iter() for child in parent}
    at = next(body for body in root.iter("body") if body.get("name") == base)
    chain = [at]
    while parents[at].tag == "body":
        at = parents[at]
        chain.insert(0, at)
    return chain


def _inherit(chain: list[ElementTree.Element]) -> None:
    """Name in each body and joint the class of defaults that it has from a body above, before that hangs below it."""
    known = "main"
    for body in chain:
        known = body.get("childclass", known)
        body.set("childclass", known)
        for joint in body.findall("joint"):
            joint.set("class", joint.get("class", known))


def _turn_round(above: ElementTree.Element, below: ElementTree.Element) -> None:
    """Hang a body on the one that hangs on it by T and turns by its joints: T R(a, u, q) has the inverse
    T^-1 R(T a, -T u, q)."""
    place = _numbers(below, "pos", (0, 0, 0))
    quaternion = _numbers(below, "quat", (1, 0, 0, 0))
    turn = rotation_matrix(quaternion / np.linalg.norm(quaternion))
    joints = below.findall("joint")
    for joint in reversed(joints):
        below.remove(joint)
        joint.set("pos", _text(place + turn @ _numbers(joint, "pos", (0, 0, 0))))
        joint.set("axis", _text(-turn @ _numbers(joint, "axis", (0, 0, 1))))
        above.append(joint)
    above.set("pos", _text(-turn.T @ place))
    above.set("quat", _text(quaternion * [1, -1, -1, -1]))


def _numbers(element: ElementTree.Element, name: str, default: tuple[float, ...]) -> Array:
    text = element.get(name)
    return np.array(default if text is None else text.split(), dtype=float)


def _text(values: Array) -> str:
    return " ".join(f"{value:.17g}" for value in values)
