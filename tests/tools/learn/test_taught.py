"""A tracker that learns from a teacher: what it is taught, that it comes nearer to that, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, resolve
from servoid.policy.motion.library import Library
from servoid.policy.tracker.network import load_tracker
from servoid.policy.tracker.observation import RESIDUAL
from servoid.policy.tracker.points import PointObservation
from servoid.stack.control.tracker import Followers
from servoid.tools.learn.envs.tracking import Tracking
from servoid.tools.learn.settings import TrackerTraining
from servoid.tools.learn.trainers.tracker import TrackerTrainer, trainer_of

ROBOT = load_robot()
SETTINGS = replace(
    TrackerTraining(), points=True, teacher="tracker", hidden=(32, 16), horizon=6, mini_batches=4, worlds=4,
    samples=1e6, hardest_push=0.0, randomised=0.0, learning_rate=2e-3,
)  # fmt: skip


def environment(**changes: object) -> Tracking:
    return Tracking(ROBOT, 4, None, replace(SETTINGS, **changes), clips=[Library(ROBOT)["wave"]])  # type: ignore[arg-type]


def test_who_does_as_it_is_taught_does_as_its_teacher() -> None:
    env = environment()
    env.reset()
    teacher = Followers(ROBOT, "tracker", "expert", (4,))
    for _ in range(30):
        expected = teacher(env.fleet.state, env.fleet.applied, env.reference)
        np.testing.assert_allclose(env.observation.base(env.frames) + RESIDUAL * env.taught, expected, atol=1e-9)
        assert np.ptp(expected - ROBOT.home) > 0.05
        _, done, _ = env.step(env.taught)
        assert not done.any()


def test_a_pupil_comes_nearer_to_its_teacher_and_runs_as_a_tracker(tmp_path: Path) -> None:
    trainer = trainer_of(environment(), SETTINGS, tmp_path)
    rows = [trainer.learn() for _ in range(6)]
    assert set(trainer.columns) - {"samples_per_s"} == set(rows[0])
    assert rows[-1]["loss/taught"] < 0.5 * rows[0]["loss/taught"]
    trainer.ship(path := tmp_path / "tracker.safetensors", {})
    network, observation = load_tracker(path, ROBOT)
    assert isinstance(observation, PointObservation)
    assert network.sizes == (observation.size, 32, 16, 20)
    by_reward = trainer_of(environment(teacher=""), replace(SETTINGS, teacher=""), tmp_path / "further")
    assert type(by_reward) is TrackerTrainer
    by_reward.adopt(path)  # PPO goes on from what was taught


def test_a_tracker_of_joints_does_not_become_one_of_key_points(tmp_path: Path) -> None:
    trainer = trainer_of(environment(), replace(SETTINGS, hidden=(256, 128)), tmp_path)
    with pytest.raises(CheckpointError, match="only one of them sees key points alone"):
        trainer.adopt(resolve("tracker"))
    with pytest.raises(ValueError, match="clip_share must not be 0"):
        replace(SETTINGS, clip_share=0.0)
