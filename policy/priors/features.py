"""What a motion prior sees of a robot: features of a frame, and of a window of frames seen from its last one.

They are those of SMP (section 6.1): velocities of the root in the heading frame of the window's last frame, height and
tilt of the root, joints, and the ends of the limbs. All come from the estimate, so that what a real robot logged can be
learned from, and scored, like a simulation.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.hw.robot.limbs import Limbs
from servoid.hw.robot.mirror import Mirror
from servoid.policy.features import AnyArray, Layout, raw_layout

ROOT = ("velocity", "angular_velocity", "height", "gravity")
SMALLEST_SHARE = 0.2  # of the deviation of its field that a feature's deviation counts as at least


class PriorFeatures:
    """Features of a robot with these limbs, and of a `box` that it carries: what interacts is one motion (SMP, 8.3)."""

    def __init__(self, robot: Robot, limbs: Limbs, box: bool = False) -> None:
        self.robot, self.limbs, self.box = robot, limbs, box
        n = len(robot.joints)
        self.layout = Layout(
            (
                ("velocity", 3),  # m/s, heading frame of the window's last frame
                ("angular_velocity", 3),  # rad/s, base frame
                ("height", 1),  # m
                ("gravity", 3),  # unit vector, base frame
                ("position", n),  # rad
                ("ends", limbs.size),  # m, base frame
                *([("box", 9)] if box else []),  # m from below the base, and its x and z axes; the frame's own heading
            )
        )
        self._raw = raw_layout(n)

    @cached_property
    def mirror(self) -> Mirror:
        """Of a frame's features."""
        joints = Mirror.joints(self.robot)
        root = Mirror.VECTOR, Mirror.ROTATION, Mirror.SCALAR, Mirror.VECTOR
        box = [Mirror.VECTOR] * 3 if self.box else []
        return Mirror.join(*root, joints, self.limbs.mirror(joints), *box)

    @cached_property
    def lower(self) -> Array:
        """Which features are of the root and of the legs `(size,)` bool: the others are of the upper body."""
        legs = {int(joint) for leg in self.robot.leg_index for joint in leg}
        at = self.layout.slice("position").start
        mask = np.zeros(self.layout.size, bool)
        mask[:at] = True
        mask[[at + joint for joint in legs]] = True
        ends = [limb.joints[-1] in legs for limb in self.limbs.limbs]
        mask[self.layout.slice("ends")] = np.repeat(ends, 3)
        return mask

    def of(self, raw: Array, box: Array | None = None) -> tuple[Array, Array]:
        """Features `(..., size)` float32 of raw rows, each seen from its own heading; and their yaw `(...)` rad.

        `box` `(..., 7)` is as `Instruction.box`. Raises ValueError where it is lacking.
        """
        if self.box and box is None:
            raise ValueError("these features are of a robot and a box, and there is none")
        row = self._raw.split(raw)
        parts = [row["velocity"], row["angular_velocity"], row["displacement"][..., 2:], row["gravity"]]
        if self.box and box is not None:
            axes = [rotate(box[..., 3:], np.broadcast_to(axis, box[..., :3].shape)) for axis in np.eye(3)[[0, 2]]]
            held = [box[..., :3], *axes]
        else:
            held = []
        frames = np.concatenate([*parts, row["position"], self.limbs.ends(row["position"]), *held], -1)
        return frames.astype(np.float32), row["yaw"][..., 0]


def seen_from_last(frames: AnyArray, yaw: AnyArray) -> AnyArray:
    """Windows `(..., frames, size)` whose velocities are each in the heading frame of their own frame, with velocities
    in that of the last one; `yaw` `(..., frames)` rad. Numpy arrays or torch tensors."""
    turn = yaw - yaw[..., -1:]
    if isinstance(frames, np.ndarray):
        c, s, window = np.cos(turn), np.sin(turn), frames.copy()
    else:
        c, s, window = turn.cos(), turn.sin(), frames.clone()
    x, y = frames[..., 0], frames[..., 1]
    window[..., 0], window[..., 1] = c * x - s * y, s * x + c * y
    return window


def deviations(frames: Array, layout: Layout) -> tuple[Array, Array]:
    """Mean and deviation `(size,)` of frames `(n, size)`; a feature that hardly moves is not blown up to noise."""
    mean, std = frames.mean(0, dtype=np.float64), frames.std(0, dtype=np.float64)
    for name, _ in layout.fields:
        at = layout.slice(name)
        std[at] = np.maximum(std[at], SMALLEST_SHARE * np.sqrt(np.mean(std[at] ** 2)))
    return mean.astype(np.float32), np.maximum(std, 1e-4).astype(np.float32)
