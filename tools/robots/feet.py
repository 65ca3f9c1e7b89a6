"""A robot's feet, found in its model by what of it is lowest: the collision geoms of their soles."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array

_FLAT = 0.004  # m above a foot's lowest point that still is its sole
_UPRIGHT = np.cos(np.deg2rad(35.0))  # of a sole where the model's joints are zero: not every robot stands so
_LARGER = 1.5  # times the area by which a tilted sole must be larger than a level one


def find_feet(
    model: mujoco.MjModel, data: mujoco.MjData, base: int, inside: Sequence[int]
) -> dict[str, tuple[str, ...]]:
    """Names of the sole's colliding geoms, of the lowest bodies left and right that nothing moves below."""
    up = data.xmat[base].reshape(3, 3)[:, 2]
    low: dict[int, float] = {}
    solid = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    for geom in solid:
        body = int(model.body_weldid[model.geom_bodyid[geom]])
        if body in inside and body != base:
            low[body] = min(low.get(body, np.inf), bottom(model, data, geom, base, up))
    feet: dict[str, tuple[str, ...]] = {}
    aside = data.xmat[base].reshape(3, 3)[:, 1]
    for name, side in (("left", 1.0), ("right", -1.0)):
        beside = {b: z for b, z in low.items() if side * float((data.xipos[b] - data.xpos[base]) @ aside) > 1e-3}
        if beside:
            foot = min(beside, key=lambda b: beside[b])
            own = [g for g in solid if model.body_weldid[model.geom_bodyid[g]] == foot]
            feet[name] = tuple(model.geom(g).name for g in _sole(model, data, own, base, up))
    return feet


def _sole(model: mujoco.MjModel, data: mujoco.MjData, own: Sequence[int], base: int, up: Array) -> list[int]:
    """Of a foot's geoms those of its sole: the lowest along the base's z, or along that axis of one of them along which
    the lowest cover clearly more: with all joints at zero, a robot's feet may be turned toe up."""
    best, area = _under(model, data, own, base, up)
    for geom in own:
        axes = data.geom_xmat[geom].reshape(3, 3)
        along = axes[:, int(np.abs(up @ axes).argmax())]
        along = along * np.sign(along @ up)
        if along @ up > _UPRIGHT:
            found, covers = _under(model, data, own, base, along)
            if covers > _LARGER * area:
                best, area = found, covers
    return best


def _under(
    model: mujoco.MjModel, data: mujoco.MjData, own: Sequence[int], base: int, up: Array
) -> tuple[list[int], float]:
    """The geoms whose lowest point along `up` is about that of all, and the area [m2] that their boxes cover."""
    lowest = [bottom(model, data, geom, base, up) for geom in own]
    found = [geom for geom, at in zip(own, lowest, strict=True) if at < min(lowest) + _FLAT]
    forward = data.xmat[base].reshape(3, 3)[:, 0]
    forward = forward - (forward @ up) * up
    sides = np.stack([forward / np.linalg.norm(forward), np.cross(up, forward / np.linalg.norm(forward))])
    ends = np.array([(_ends(model, data, geom, side)) for geom in found for side in sides]).reshape(-1, 2, 2)
    return found, float(np.prod(ends[:, :, 1].max(0) - ends[:, :, 0].min(0)))


def _ends(model: mujoco.MjModel, data: mujoco.MjData, geom: int, along: Array) -> tuple[float, float]:
    """Lowest and highest coordinate [m] of a geom's box along a direction of the world."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    own = data.geom_xmat[geom].reshape(3, 3).T @ along
    middle, reach = float(data.geom_xpos[geom] @ along + own @ centre), float(np.abs(own) @ half)
    return middle - reach, middle + reach


def bottom(model: mujoco.MjModel, data: mujoco.MjData, geom: int, base: int, up: Array) -> float:
    """The lowest height [m] of a geom's box above the base's origin, along `up` `(3,)`."""
    return _ends(model, data, geom, up)[0] - float(data.xpos[base] @ up)


def hip_height(model: mujoco.MjModel, data: mujoco.MjData, body: int, base: int) -> float:
    """Height of the first body of the limb that this one is of, in the base's frame [m]."""
    while model.body_parentid[body] != base:
        body = int(model.body_parentid[body])
    return float((data.xpos[body] - data.xpos[base]) @ data.xmat[base].reshape(3, 3)[:, 2])
