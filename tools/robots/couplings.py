"""Joints that a model ties to others: by a gear or a belt, by a linkage, or several to several.

A robot's joints are those of its limbs. Where the servo's horn is a joint of its own, beside the limb's, and the two
turn together in a constant ratio, that ratio is the joint's `gear`, and the horn needs no joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from servoid.hw.config import ConfigError

_ON_JOINTS = {int(kind) for kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
_LOOPS = {int(kind) for kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)}


@dataclass(frozen=True)
class Couplings:
    """Names of joints. `gears`: of limbs that turn by a horn beside them, that horn and its turns for one of the limb.
    `followers` turn with a joint of the robot and bear no limb, `looped` are moved by closed loops alone. `tangled` are
    tied several to several."""

    gears: dict[str, tuple[str, float]]
    followers: tuple[str, ...]
    looped: tuple[str, ...]
    tangled: tuple[str, ...]


def couplings(model: mujoco.MjModel, path: Path) -> Couplings:
    """What the constraints of a model say. Raises ConfigError for a horn whose ratio to its limb varies."""
    driven = {int(model.actuator_trnid[i, 0]) for i in range(model.nu) if int(model.actuator_trntype[i]) in _ON_JOINTS}
    gears: dict[str, tuple[str, float]] = {}
    followers: list[str] = []
    for i in range(model.neq):
        first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if model.eq_type[i] != mujoco.mjtEq.mjEQ_JOINT or second < 0:
            continue
        horn = first if first in driven and second not in driven else second
        other = second if horn == first else first
        names = model.joint(horn).name, model.joint(other).name
        if not _beside(model, horn, other) or _mass(model, horn) >= _mass(model, other):
            followers.append(names[1])
            continue
        if np.any(model.eq_data[i, 2:5]) or not model.eq_data[i, 1]:
            raise ConfigError(
                f"{path}: {names[1]} turns with {names[0]} in a ratio that varies, or in none (polycoef "
                f"{' '.join(f'{x:g}' for x in model.eq_data[i, :5])}), and no gear of a servo does: give the ratio "
                "about the home pose alone, as the second number"
            )
        ratio = abs(float(model.eq_data[i, 1]))
        gears[names[1]] = names[0], 1.0 / ratio if other == first else ratio
    return Couplings(gears, tuple(dict.fromkeys(followers)), _looped(model, driven), _tangled(model, driven))


def _beside(model: mujoco.MjModel, horn: int, limb: int) -> bool:
    """Whether nothing hangs on the horn that the limb is of: it only turns."""
    return int(model.jnt_bodyid[horn]) not in _above(model, int(model.jnt_bodyid[limb]))


def _mass(model: mujoco.MjModel, joint: int) -> float:
    return float(model.body_subtreemass[model.jnt_bodyid[joint]])


def _tangled(model: mujoco.MjModel, driven: set[int]) -> tuple[str, ...]:
    """Joints of fixed tendons that tie a joint without a motor to several that have one, such as a differential's."""
    found: list[str] = []
    for tendon in range(model.ntendon):
        wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        joints = [int(model.wrap_objid[w]) for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT]
        if len(driven & set(joints)) > 1 and set(joints) - driven:
            found += [model.joint(j).name for j in joints]
    return tuple(dict.fromkeys(found))


def _looped(model: mujoco.MjModel, driven: set[int]) -> tuple[str, ...]:
    """Joints without a motor in closed loops with some that have one: the rods of a linkage, and what they move."""
    found: list[str] = []
    for i in range(model.neq):
        ends = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if int(model.eq_type[i]) not in _LOOPS or min(ends) < 0:
            continue
        if model.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
            ends = int(model.site_bodyid[ends[0]]), int(model.site_bodyid[ends[1]])
        loop = _above(model, ends[0]) ^ _above(model, ends[1])
        joints = [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in loop]
        if driven & set(joints):
            found += [model.joint(j).name for j in joints if j not in driven]
    return tuple(dict.fromkeys(found))


def _above(model: mujoco.MjModel, body: int) -> set[int]:
    """The body and those that it hangs on, without the world."""
    found = set[int]()
    while body:
        found.add(body)
        body = int(model.body_parentid[body])
    return found
