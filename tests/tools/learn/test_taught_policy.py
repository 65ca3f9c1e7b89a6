"""A task policy that learns from a teacher: who acts when, what it is taught, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.priors.score_matching.model import Style, load_prior
from servoid.policy.priors.task_policy import TaskPolicy
from servoid.policy.references.style import load_style
from servoid.sim.kinematics import limbs_of
from servoid.stack.tasks.learned import load_learned_task
from servoid.tools.learn.envs.task_environment import TaskEnvironment
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.trainers.policy import environment, trainer_of
from servoid.tools.learn.trainers.taught import TaughtPolicyTrainer

ROBOT = load_robot()
SETTINGS = replace(
    PolicyTraining(), teacher="expert", hidden=(32, 16), horizon=8, mini_batches=6, worlds=4, samples=400, mirror=0.0,
    randomised=0.0, generated=0.0, episode_seconds=4.0, learning_rate=2e-3, noise=(0.02, 0.02),
)  # fmt: skip


def trainer(out: Path, **changes: object) -> TaughtPolicyTrainer:
    settings = replace(SETTINGS, **changes)  # type: ignore[arg-type]
    env = environment(load_learned_task("speed", ROBOT), None, Style(), settings, 4, 0)
    made = trainer_of(env, Style(), settings, out, None)
    assert isinstance(made, TaughtPolicyTrainer)
    return made


@pytest.mark.slow
def test_a_pupil_comes_nearer_to_its_teacher_and_runs_as_a_task_policy(tmp_path: Path) -> None:
    torch.manual_seed(0)
    taught = trainer(tmp_path)
    rows = [taught.learn() for _ in range(7)]
    assert set(rows[0]) <= set(taught.columns)
    assert rows[-1]["loss/taught"] < 0.4 * rows[0]["loss/taught"]
    taught.ship(path := tmp_path / "policy.safetensors", {})
    assert TaskPolicy(ROBOT, path).goal == "velocity"


@pytest.mark.slow
def test_the_teacher_acts_for_its_share_and_after_every_turn_of_its_pupil(tmp_path: Path) -> None:
    taught, idle = trainer(tmp_path), np.zeros((4, 20))
    for _ in range(5):
        taught.lesson(idle, 1.0)
        assert taught.teacher.leads.all()
    assert np.abs(taught.env.fleet.applied - ROBOT.home).max() > 0.01  # it walks, and its pupil would stand
    led = []
    for _ in range(300):
        _, told = taught.lesson(idle, 0.5)
        led.append(taught.teacher.leads.copy())
        assert np.isfinite(told).all()
    assert 0.35 < np.mean(led) < 0.65
    longest = np.diff(np.flatnonzero(np.diff(np.array(led, int), axis=0)[:, 0])).max()
    assert longest <= 63  # 2.5 s


def test_an_unknown_teacher_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nobody-there"):
        trainer(tmp_path, teacher="nobody-there")


@pytest.mark.slow
def test_in_a_style_the_teacher_walks_so_each_half_in_its_own(tmp_path: Path) -> None:
    style = Style.parse("zombie+wide")
    prior = load_prior(checkpoint.resolve("styles"), ROBOT, limbs_of(ROBOT))
    env = environment(load_learned_task("speed", ROBOT), prior, style, SETTINGS, 4, 0)
    taught = trainer_of(env, style, SETTINGS, tmp_path, checkpoint.resolve("styles"))
    assert isinstance(taught, TaughtPolicyTrainer)
    env.ticks[:] = 0  # no episode ends meanwhile
    before = apart(env)
    for _ in range(75):
        _, told = taught.lesson(np.zeros((4, 20)), 1.0)
    targets, whole = ROBOT.home + env.reach * told, env.ticks == 75  # who fell begins anew
    held, at, _ = load_style("zombie", ROBOT).held(ROBOT)
    assert whole.sum() >= 2
    assert np.allclose(targets[np.ix_(whole, held)], at[held], atol=0.02)
    assert (apart(env)[whole] > before[whole] + 0.02).all()


def test_who_knows_no_gait_teaches_no_style(tmp_path: Path) -> None:
    style, settings = Style.parse("zombie"), replace(SETTINGS, teacher="speed")
    prior = load_prior(checkpoint.resolve("styles"), ROBOT, limbs_of(ROBOT))
    env = environment(load_learned_task("speed", ROBOT), prior, style, settings, 4, 0)
    with pytest.raises(CheckpointError, match="tracker"):
        trainer_of(env, style, settings, tmp_path, checkpoint.resolve("styles"))


def apart(env: TaskEnvironment) -> Array:
    """How far the feet of each robot are apart `(n,)` m."""
    feet = env.fleet.truth.foot_position
    return np.asarray(np.linalg.norm(feet[:, 1, :2] - feet[:, 0, :2], axis=-1))
