"""PPO on an environment that is no robot: what a second environment has to bring is what `Environment` lists."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from servoid.hw.contracts.body import Array
from servoid.hw.robot.mirror import Mirror
from servoid.tools.learn.settings import Ppo
from servoid.tools.learn.terms import StatefulTerm, Terms
from servoid.tools.learn.trainers.ppo import Environment, PpoTrainer


class Dawdling(StatefulTerm[Array]):
    """How far off the beads of an episode were on average."""

    def __init__(self, n: int) -> None:
        self.total, self.ticks = np.zeros(n), np.zeros(n)

    def reset(self, where: Array) -> None:
        self.total[where] = self.ticks[where] = 0.0

    def __call__(self, step: Array) -> Array:
        self.total, self.ticks = self.total + np.abs(step), self.ticks + 1
        return self.total / self.ticks


class Beads:
    """Beads on a wire, to be pushed to its middle."""

    action_size = 1
    mirrors: Mapping[str, Mirror] = {"action": Mirror.FLIPPED, "actor": Mirror.FLIPPED, "critic": Mirror.FLIPPED}
    measures: Mapping[str, float] = {}

    def __init__(self, n: int) -> None:
        self.n, self.ticks, self.terms = n, np.zeros(n, int), dict[str, float]()
        self.progress: list[float] = []
        self._rng, self._place, self._dawdling = np.random.default_rng(0), np.zeros(n), Dawdling(n)
        self._reward = Terms(
            {"near": 1.0, "dawdling": -0.1}, {"near": lambda x: np.exp(-(x**2))}, {"dawdling": self._dawdling}
        )
        self.term_names = self._reward.names
        self.observations: Mapping[str, Array] = {}

    def _begin(self, where: Array) -> None:
        self._place[where] = self._rng.uniform(-2.0, 2.0, int(where.sum()))
        self.ticks[where] = 0
        self._reward.reset(where)

    def _observe(self) -> None:
        seen = self._place[:, None].astype(np.float32)
        self.observations = {"actor": seen, "critic": seen}

    def reset(self) -> None:
        self._begin(np.ones(self.n, bool))
        self._observe()

    def schedule(self, progress: float) -> None:
        self.progress.append(progress)

    def step(self, action: Array) -> tuple[Array, Array, Array]:
        self._place = self._place + 0.5 * np.clip(action[:, 0], -1.0, 1.0)
        self.ticks = self.ticks + 1
        reward, self.terms = self._reward(self._place)
        lost, late = np.abs(self._place) > 4.0, self.ticks >= 20
        if (done := lost | late).any():
            self._begin(done)
        self._observe()
        return reward, done, late & ~lost


class BeadTrainer(PpoTrainer):
    """Leaves what it normalises its inputs by."""

    title = following = "beads"

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        path.write_bytes(self.actor().mean.tobytes())


@pytest.mark.slow
def test_a_second_environment_is_learned_in_the_same_loop(tmp_path: Path) -> None:
    torch.manual_seed(0)
    env = Beads(64)
    checked: Environment = env
    settings = Ppo(
        samples=64 * 20 * 15,
        worlds=64,
        horizon=20,
        hidden=(16,),
        noise=(0.5, 0.1),
        learning_rate=3e-3,
        evaluate_every=0,
    )
    trainer = BeadTrainer(checked, settings, tmp_path, "beads")
    trainer.start(resume=True)
    trainer.prepare()
    first = trainer.learn()
    trainer.run()
    last = trainer.learn()
    assert last["term/near"] > first["term/near"] + 0.2
    assert last["term/dawdling"] > first["term/dawdling"]  # it costs less
    assert env.progress == sorted(env.progress)
    assert env.progress[-1] == 1.0
    assert {"term/near", "term/dawdling"} <= set((tmp_path / "log.csv").read_text().splitlines()[0].split(","))
    assert (tmp_path / "resume.pt").exists()


def test_an_actor_that_begins_with_something_learns_more_slowly_than_its_critic(tmp_path: Path) -> None:
    moved = {}
    for rate in (1.0, 0.01):
        torch.manual_seed(0)
        settings = Ppo(samples=64 * 40, worlds=64, horizon=20, hidden=(8,), actor_rate=rate, mirrored=False)
        trainer = BeadTrainer(Beads(64), settings, tmp_path / str(rate), "beads")
        parts = trainer.ppo.actor.mlp, trainer.ppo.critic.mlp
        before = [[p.detach().clone() for p in part.parameters()] for part in parts]
        trainer.learn()
        moved[rate] = [
            max(float((p.detach() - q).abs().max()) for p, q in zip(part.parameters(), old, strict=True))
            for part, old in zip(parts, before, strict=True)
        ]
    assert moved[0.01][0] < 0.05 * moved[1.0][0]
    assert moved[0.01][1] == pytest.approx(moved[1.0][1], rel=0.3)
