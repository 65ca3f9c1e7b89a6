"""A tracker learns what other trackers would do wherever it comes itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.tools.learn.envs.tracking import Tracking
from servoid.tools.learn.settings import TrackerTraining
from servoid.tools.learn.taught.pupil import Taught
from servoid.tools.learn.trainers.tracker import TrackerTrainer


class TaughtTrainer(Taught, TrackerTrainer):
    """As `TrackerTrainer`, of an environment with a teacher."""

    def __init__(self, env: Tracking, settings: TrackerTraining, out: Path) -> None:
        super().__init__(env, settings, out)
        self.begin_lessons(env, settings)

    def lesson(self, action: Array, led: float) -> tuple[Array, Array]:
        taught = self.env.taught
        leads = self._rng.random(self.env.n) < led
        reward, _, _ = self.env.step(np.where(leads[:, None], taught, action))
        return reward, taught
