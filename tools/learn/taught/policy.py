"""A task policy learns what its teacher would do wherever it comes itself, by turns with the teacher."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.tools.learn.envs.task_environment import TaskEnvironment
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.taught.pupil import Taught
from servoid.tools.learn.taught.teacher import Teacher
from servoid.tools.learn.trainers.policy import PolicyTrainer

if TYPE_CHECKING:
    from servoid.policy.priors.score_matching.model import Style

_TURNS = 0.4, 2.5  # s for which one of them acts


class TaughtPolicyTrainer(Taught, PolicyTrainer):
    """As `PolicyTrainer`, of an environment with a teacher.

    The teacher acts after each turn of its pupil: what it would do where a pupil went long before, in another phase of
    the gait say, means little.
    """

    LAST = "last.safetensors"
    kept, led, led_last = 300_000, 0.4, 0.5

    def __init__(
        self, env: TaskEnvironment, style: Style, settings: PolicyTraining, out: Path, prior: Path | None
    ) -> None:
        """`env` has a teacher."""
        super().__init__(env, style, settings, out, prior)
        assert env.teacher is not None
        self.teacher: Teacher = env.teacher
        self.begin_lessons(env, settings)
        self._left = np.zeros(env.n, int)  # decisions of the present turns

    def score(self, results: Mapping[str, float]) -> tuple[float, float]:
        """The best return: a pupil that stops somewhere, where it did not before, does worse though it errs less."""
        return results.get("return", 0.0), float(self.step)

    def lesson(self, action: Array, led: float) -> tuple[Array, Array]:
        env = self.env
        over = self._left == 0
        turns = np.rint(self._rng.uniform(*_TURNS, env.n) / env.dt).astype(int)
        self._left = np.where(over, turns, self._left) - 1
        # The pupil after one of the teacher's turns, so often that the teacher acts for a share `led` of the time.
        leads = ~self.teacher.leads | (self._rng.random(env.n) * led >= 1.0 - led)
        self.teacher.leads = np.where(over, leads, self.teacher.leads)
        reward, _, _ = env.step(action)
        return reward, (self.teacher.taught() - env.robot.home) / env.reach
