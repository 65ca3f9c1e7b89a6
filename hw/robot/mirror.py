"""Left and right swapped, as a mirror through the robot's x-z plane shows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot


@dataclass(frozen=True)
class Mirror:
    """A vector of `n` numbers seen in the mirror: `x[..., index] * sign`. It is its own inverse."""

    index: Array  # (n,) int
    sign: Array  # (n,) float32, 1 or -1

    SCALAR: ClassVar[Mirror]  # unchanged
    FLIPPED: ClassVar[Mirror]  # a yaw, or a component to the left
    PLANAR: ClassVar[Mirror]  # (x, y)
    VECTOR: ClassVar[Mirror]  # (x, y, z)
    ROTATION: ClassVar[Mirror]  # angular velocity (x, y, z)

    def __call__(self, x: Any) -> Any:
        """Mirror `(..., n)`, a numpy array or a torch tensor."""
        sign = self.sign if isinstance(x, np.ndarray) else x.new_tensor(self.sign)
        return x[..., self.index] * sign

    @staticmethod
    def join(*parts: Mirror) -> Mirror:
        """The mirror of the parts' concatenation."""
        starts = np.cumsum([0, *(len(part.index) for part in parts[:-1])])
        return Mirror(
            np.concatenate([part.index + start for part, start in zip(parts, starts, strict=True)]),
            np.concatenate([part.sign for part in parts]),
        )

    @staticmethod
    def joints(robot: Robot) -> Mirror:
        """Of joint positions, velocities or efforts."""
        index, sign = robot.mirror
        return Mirror(index, sign.astype(np.float32))

    @staticmethod
    def feet(robot: Robot) -> Mirror:
        """Of one number a foot: the foot at the end of the mirrored leg."""
        legs, index = robot.leg_index[:, -1].tolist(), robot.mirror[0]
        return Mirror(np.array([legs.index(index[joint]) for joint in legs]), np.ones(len(legs), np.float32))

    @staticmethod
    def vectors(feet: Mirror) -> Mirror:
        """Of a velocity (x, y, z) a foot, foot after foot."""
        index = (feet.index[:, None] * 3 + np.arange(3)).reshape(-1)
        return Mirror(index, np.tile(Mirror.VECTOR.sign, len(feet.index)))


def _signs(*signs: float) -> Mirror:
    return Mirror(np.arange(len(signs)), np.array(signs, np.float32))


Mirror.SCALAR, Mirror.FLIPPED = _signs(1), _signs(-1)
Mirror.PLANAR, Mirror.VECTOR, Mirror.ROTATION = _signs(1, -1), _signs(1, -1, 1), _signs(-1, 1, -1)
