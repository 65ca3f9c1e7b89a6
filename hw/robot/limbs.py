"""Where the ends of a robot's limbs are, by its joints: forward kinematics over any leading dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import cross
from servoid.hw.robot.mirror import Mirror


@dataclass(frozen=True)
class Limb:
    """A chain of hinges from the base to an end, as it is with all joints at 0, in the base frame [m]."""

    joints: tuple[int, ...]  # numbers in the robot's order, from the base outward
    anchors: Array  # (k, 3) places of the hinges
    axes: Array  # (k, 3) unit vectors
    tip: Array  # (3,) the end

    def end(self, joints: Array) -> tuple[Array, Array]:
        """Place of the end `(..., 3)` m in the base frame at `joints` `(..., n_joints)` rad, and its change `(..., k,
        3)` m/rad with each of the limb's joints.

        Each hinge turns all that lies beyond it about its axis at rest, the outermost first (product of exponentials).
        """
        place = np.broadcast_to(self.tip, (*joints.shape[:-1], 3))
        levers: list[Array] = []
        for joint, anchor, axis in zip(self.joints[::-1], self.anchors[::-1], self.axes[::-1], strict=True):
            angle = joints[..., joint, None]
            cos, sin = np.cos(angle), np.sin(angle)

            def turned(arm: Array, axis: Array = axis, cos: Array = cos, sin: Array = sin) -> Array:
                along = axis * (arm @ axis)[..., None]
                whole: Array = along + cos * (arm - along) + sin * cross(axis, arm)
                return whole

            arm = turned(place - anchor)
            place, levers = anchor + arm, [cross(axis, arm), *(turned(lever) for lever in levers)]
        return place, np.stack(levers, -2)


@dataclass(frozen=True)
class Limbs:
    """All limbs of a robot."""

    limbs: tuple[Limb, ...]

    @property
    def size(self) -> int:
        """Numbers that describe the ends."""
        return 3 * len(self.limbs)

    def ends(self, joints: Array) -> Array:
        """Places `(..., 3 limbs)` m of the ends in the base frame, at `joints` `(..., n_joints)` rad."""
        return np.concatenate([limb.end(joints)[0] for limb in self.limbs], -1)

    def mirror(self, joints: Mirror) -> Mirror:
        """Of the ends, where `joints` is that of the joints: a limb becomes that whose outermost joint mirrors its own.

        Raises ValueError for limbs that have no counterpart.
        """
        outer = [limb.joints[-1] for limb in self.limbs]
        pairs = [int(joints.index[joint]) for joint in outer]
        if set(pairs) != set(outer):
            raise ValueError("the robot's limbs are not the same in a mirror")
        swapped = Mirror(np.array([outer.index(joint) for joint in pairs]), np.ones(len(outer), np.float32))
        return Mirror.vectors(swapped)

    def to_header(self) -> list[dict[str, Any]]:
        """As a checkpoint stores them."""
        parts = ("anchors", "axes", "tip")
        return [
            {"joints": list(limb.joints), **{name: np.round(getattr(limb, name), 6).tolist() for name in parts}}
            for limb in self.limbs
        ]

    @staticmethod
    def from_header(limbs: Sequence[Mapping[str, Any]]) -> Limbs:
        """Inverse of `to_header`. Raises KeyError or ValueError where it is not one."""
        return Limbs(
            tuple(
                Limb(tuple(limb["joints"]), *(np.array(limb[name], float) for name in ("anchors", "axes", "tip")))
                for limb in limbs
            )
        )
