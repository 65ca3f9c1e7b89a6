"""Terms of the guidance cost about parts of the robot's body: a hand that touches something, a head under a bar."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.limbs import Limb
from servoid.policy.trajectory import Slope, Trajectory
from servoid.stack.tasks.terms.places import norm
from servoid.stack.tasks.terms.weights import Weights


@dataclass(frozen=True)
class Build:
    """What the terms need to know of a robot's body."""

    limbs: Mapping[str, Limb]  # by the names of their ends: "right hand"
    top: float  # m, how far its highest part is above the base in the home pose


def upright_axes(gravity: Array) -> Array:
    """Axes of the heading frame `(..., 3, 3)`, a row each, in the base frame, where `gravity` `(..., 3)` points."""
    up = -gravity / norm(gravity)[..., None]
    ahead = np.array([1.0, 0.0, 0.0]) - up[..., :1] * up
    ahead /= norm(ahead)[..., None]
    return np.stack([ahead, np.cross(up, ahead), up], -2)


def limb_ends(limb: Limb, place: Array, yaw: Array, gravity: Array, joints: Array) -> Array:
    """Where a limb ends `(..., 3)` m, of a base at `place` `(..., 3)` with heading `yaw`, in the frame of both."""
    ahead, left, up = np.moveaxis((upright_axes(gravity) * limb.end(joints)[0][..., None, :]).sum(-1), -1, 0)
    cos, sin = np.cos(yaw), np.sin(yaw)
    end: Array = place + np.stack([cos * ahead - sin * left, sin * ahead + cos * left, up], -1)
    return end


def reach_cost(
    trajectory: Trajectory, targets: Mapping[str, Array], build: Build, weights: Weights
) -> tuple[Array, Slope]:
    """Distance of ends of limbs from their targets `(3,)` m, by the predicted joints (Diffuse-CLoC's task space).

    The slope leaves out how the base leans: no robot shall lean over to reach.
    """
    t, shares = trajectory, trajectory.shares
    cost = np.zeros(t.yaw.shape[:-1])
    slope = {name: np.zeros(getattr(t, name).shape) for name in ("displacement", "yaw", "height", "joints")}
    cos, sin, axes = np.cos(t.yaw), np.sin(t.yaw), upright_axes(t.gravity)
    for name in targets.keys() & build.limbs.keys():
        limb = build.limbs[name]
        end, lever = limb.end(t.joints)
        ahead, left, up = np.moveaxis((axes * end[..., None, :]).sum(-1), -1, 0)
        x, y = cos * ahead - sin * left, sin * ahead + cos * left  # from the base
        off = np.stack([t.displacement[..., 0] + x, t.displacement[..., 1] + y, t.height + up], -1) - targets[name]
        distance = norm(off)
        cost = cost + weights.reach * (distance @ shares)
        pull = (weights.reach * shares / distance)[..., None] * off
        slope["displacement"] += pull[..., :2]
        slope["height"] += pull[..., 2]
        slope["yaw"] += pull[..., 1] * x - pull[..., 0] * y
        turned = np.stack(
            [cos * pull[..., 0] + sin * pull[..., 1], cos * pull[..., 1] - sin * pull[..., 0], pull[..., 2]], -1
        )
        by_end = (axes * turned[..., None]).sum(-2)
        slope["joints"][..., list(limb.joints)] += (lever * by_end[..., None, :]).sum(-1)
    return cost, slope


def bar_cost(trajectory: Trajectory, bars: Array, build: Build, weights: Weights) -> tuple[Array, Slope]:
    """How far the robot's top is above where it clears bars `(n, 5)`, squared, while it is beneath them.

    A bar is x, y m of its middle, rad of its direction, half its length and the height of its lower edge, m. That the
    robot is beneath is taken as given: whoever is told to be low shall not stop before the bar instead.
    """
    w, shares = weights, trajectory.shares
    middle, direction, half, edge = np.split(np.asarray(bars, dtype=float), [2, 3, 4], axis=-1)
    along = np.concatenate([np.cos(direction), np.sin(direction)], -1)
    apart = trajectory.displacement[..., None, :] - middle  # (..., horizon, n, 2)
    beside = np.clip((apart * along).sum(-1), -half[:, 0], half[:, 0])
    beneath = norm(apart - beside[..., None] * along) < w.beneath
    over = np.maximum(trajectory.height[..., None] + build.top + w.gap - edge[:, 0], 0.0) * beneath
    cost: Array = w.bar * ((over**2).sum(-1) @ shares)
    return cost, {"height": 2.0 * w.bar * shares * over.sum(-1)}
