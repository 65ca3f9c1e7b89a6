"""How episodes of imitating a clip begin: in its first pose, or anywhere along it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.tools.learn.envs.starts import States, along

_ROLLED_OUT = 16  # bodies that follow the clip, open loop


class AlongClip:
    """Draws the states that episodes begin in: a `share` of them along the clip, as it really goes."""

    def __init__(self, robot: Robot, clip: Clip, share: float, seed: int) -> None:
        """Rolls out bodies first. Raises ConfigError where a share is to begin along a clip that fails open loop."""
        self._share, self._states = share, None
        joints = np.clip(clip.joints[:1], robot.lower, robot.upper)
        self._first = joints, clip.root_orientation[:1]
        if share > 0.0:
            self._states = along(robot, [clip], _ROLLED_OUT, seed)
            if not len(self._states.joints):
                raise ConfigError(
                    f"clip '{clip.name}': none of {_ROLLED_OUT} robots comes to its end open loop, so no episode can "
                    "begin along it: use --generated 0"
                )

    def draw(self, rngs: Sequence[np.random.Generator], where: Array) -> Start:
        """Starts of the worlds `where` `(n,)` bool; a row for each world."""
        n = len(where)
        joints, orientation = (np.tile(part, (n, 1)) for part in self._first)
        still = np.zeros((n, 3))
        begin = Start(
            joints=joints, position=np.tile([0.0, 0.0, np.nan], (n, 1)), orientation=orientation, velocity=still,
            angular_velocity=still.copy(), joint_velocity=np.zeros_like(joints),
        )  # fmt: skip
        if self._states is None:
            return begin
        picked = np.full(n, -1)
        for i in np.flatnonzero(where).tolist():
            if rngs[i].random() < self._share:
                picked[i] = rngs[i].integers(len(self._states.joints))
        return _either(picked >= 0, self._states.only(np.maximum(picked, 0)), begin)


def _either(moves: Array, moving: States, begin: Start) -> Start:
    """The states of `moving` in the worlds `moves` `(n,)` bool, those of `begin` elsewhere."""
    parts = ("joints", "position", "orientation", "velocity", "angular_velocity", "joint_velocity")
    chosen = {name: np.where(moves[:, None], vars(moving)[name], getattr(begin, name)) for name in parts}
    return Start(**chosen)
