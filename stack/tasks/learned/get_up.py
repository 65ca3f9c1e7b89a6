"""Get up (SMP, section 7): from any lying pose, or a fall, to standing still at home, as soon as possible."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.policy.motion.library import Library
from servoid.policy.rising.lead import CLIPS, Rising
from servoid.stack.safety.recovery import AT_HOME, UPRIGHT
from servoid.stack.tasks.learned.base import LearnedTask, TaskState

_LYING = 0.25  # of the standing height: where a base that lies is
_TALL = 0.85  # of the standing height: it stands on straight legs
_NEAR = 0.5  # rad of a joint from home, root mean square, at which the pose still counts for e^-1
_QUIET = 1.0  # rad/s, likewise of the base and of the joints


class GettingUp(LearnedTask):
    """Nothing is asked but to stand, and no fall is an end.

    It is achieved as the guard sees it, who lets the robot go on then, but for joints at rest: what explores has none.
    """

    name, goal, size, every, run = "get-up", "stand", 0, (1e6, 1e6), "get-up"
    lies = True
    hold = 1.0

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        return np.zeros(0)

    def instruct(self, asked: Array, state: State) -> Instruction:
        return Instruction(velocity=np.zeros((*np.shape(state.yaw), 3)))

    def reward(self, asked: Array, state: TaskState) -> Array:
        """Upright, then high, and where both, at home and still."""
        up = -state.gravity[:, 2]
        upright = 0.5 * (1.0 + up)
        tall = np.clip((state.height / self.robot.standing_height - _LYING) / (1.0 - _LYING), 0.0, 1.0)
        stands = np.clip((up - 0.8) / 0.2, 0.0, 1.0) * np.clip((tall - 0.7) / 0.25, 0.0, 1.0)
        home = np.exp(-(((state.joints - self.robot.home) / _NEAR) ** 2).mean(-1))
        moves = (state.joint_velocity**2).mean(-1) + (state.angular_velocity**2).sum(-1)
        still = np.exp(-moves / _QUIET**2)
        return 0.2 * upright + 0.3 * tall * upright + stands * home * (0.25 + 0.25 * still)

    def achieved(self, state: TaskState) -> Array:
        home = np.abs(state.joints - self.robot.home).max(-1) < AT_HOME
        tall = state.height > _TALL * self.robot.standing_height
        return home & tall & (-state.gravity[:, 2] > np.cos(UPRIGHT))


class GettingUpByClips(GettingUp):
    """The same, led by the clips that get up: it begins with what they can do, and learns to be sure and quick."""

    name = "get-up-by-clips"

    def lead(self, n: int) -> Rising:
        library = Library(self.robot)
        return Rising(self.robot, [library[name] for name in CLIPS], (n,))
