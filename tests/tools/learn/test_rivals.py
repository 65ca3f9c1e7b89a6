"""What rewards in the place of a prior, to compare with: a discriminator (AMP), learning or frozen, and SMILING."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_prior import write_prior

from servoid.hw.robot.description import load_robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.priors.adversarial.discriminator import (
    Adversary,
    Discriminator,
    load_discriminator,
)
from servoid.policy.priors.adversarial.smiling import OwnScore
from servoid.policy.priors.score_matching.model import Style, load_prior
from servoid.policy.priors.score_matching.score import Score
from servoid.policy.priors.score_matching.windows import PriorWindows
from servoid.policy.recording import read_recording
from servoid.sim.kinematics import limbs_of
from servoid.stack.tasks.learned import load_learned_task
from servoid.tools.learn.envs.score_term import Rival, SmilingTerm
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.trainers.policy import environment

ROBOT = load_robot()
SETTINGS = replace(PolicyTraining(), hidden=(16,), episode_seconds=0.4, worlds=6, starts=8)


@pytest.fixture(scope="module")
def prior(synthetic_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_prior(synthetic_dataset, tmp_path_factory.mktemp("prior"))


def test_smiling_pays_nothing_for_what_the_prior_knows_as_well_and_charges_for_the_rest(prior: Path) -> None:
    """Both denoisers see the same noise: as long as they are one, the reward is exactly nought; once the second has
    learned motion that the prior does not know, that costs."""
    known = load_prior(prior, ROBOT, limbs_of(ROBOT))
    own, judge, scale = OwnScore(known, 0), Score(known, Style(), 0), np.ones(3)
    own.network.load_state_dict(known.network.state_dict())
    elsewhere = known.decode(torch.full((64, known.config.frames, known.config.size), 3.0))
    assert own.reward(elsewhere, judge(elsewhere), scale) == pytest.approx(np.zeros(64))
    losses = [own.learn()["own_loss"] for _ in range(20)]
    assert losses[-1] < 0.7 * losses[0]
    assert own.reward(elsewhere, judge(elsewhere), scale).mean() < -0.3


def test_smiling_rewards_in_the_place_of_the_prior(prior: Path) -> None:
    known = load_prior(prior, ROBOT, limbs_of(ROBOT))
    settings = replace(SETTINGS, rewards={"manner": 1.0}, generated=0.0)
    env = environment(load_learned_task("speed", ROBOT), known, Style(), settings, 6, 0, SmilingTerm)
    env.reset()
    rewards = [env.step(np.zeros((env.n, env.action_size)))[0] for _ in range(3)]
    assert np.isfinite(rewards).all()
    assert (env.score.ratio > 0).all()  # the prior goes on measuring
    assert env.score.learn()["own_loss"] > 0.0


@pytest.mark.slow
def test_a_discriminator_learns_along_and_rewards_frozen(prior: Path, synthetic_dataset: Path, tmp_path: Path) -> None:
    """AMP in the same environment: it comes to tell the policy's windows, and its file rewards another training."""
    known = load_prior(prior, ROBOT, limbs_of(ROBOT))
    recordings = {"": read_recording(synthetic_dataset, ROBOT)}
    discriminator = Discriminator(known)
    adversary = Adversary(discriminator, PriorWindows(recordings, known.features, known.config), 0)
    makes = Rival(discriminator, adversary).term
    env = environment(load_learned_task("speed", ROBOT), known, Style(), replace(SETTINGS, generated=0.0), 6, 0, makes)
    env.reset()
    for _ in range(6):
        env.step(np.ones((env.n, env.action_size)))
    told = [env.score.learn() for _ in range(60)][-1]
    assert told["tells_data"] > 0.9
    assert told["tells_policy"] > 0.9
    env.score.keep(tmp_path, {"data": "", "licence": "", "results": {}})
    file = tmp_path / "discriminator.safetensors"
    frozen = load_discriminator(file, known)
    real = adversary._data.held_out(20)[0] * known.std + known.mean
    assert np.array_equal(frozen.reward(real), discriminator.reward(real))
    assert frozen.reward(real).mean() > frozen.reward(adversary.memory.windows).mean()
    again = environment(load_learned_task("speed", ROBOT), known, Style(), SETTINGS, 6, 0, Rival(frozen, None).term)
    again.reset()
    again.step(np.zeros((6, again.action_size)))
    assert again.score.learn() == {}
    again.score.keep(tmp_path / "nowhere", {})  # what stays as it is has a file
    head, tensors = checkpoint.read(file)
    checkpoint.write(file, tensors, {**head, "config": {**head["config"], "stride": 1}})
    with pytest.raises(CheckpointError, match="stride 1"):
        load_discriminator(file, known)
