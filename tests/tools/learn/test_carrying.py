"""Carrying, from data to a policy: what is recorded, what a prior sees of it, and the worlds that it is learned in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.geometry import yaw_of
from servoid.hw.robot.description import load_robot
from servoid.policy.priors.features import PriorFeatures
from servoid.policy.priors.goals import GOALS
from servoid.policy.priors.score_matching.model import Style, load_prior
from servoid.policy.recording import Recording, read_recording
from servoid.sim.kinematics import limbs_of
from servoid.stack.tasks.learned import load_learned_task
from servoid.stack.tasks.learned.carry import STANDS
from servoid.tools import cli
from servoid.tools.learn.demonstrations import demonstrated
from servoid.tools.learn.envs.starts import AlongCarrying
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.trainers.policy import environment

ROBOT = load_robot()
COMMAND = "collect --carry --worlds 6 --frames 2160 --seconds 9 --noise 0 0 --randomise 0 --threads 1 --json --out"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collect") / "carrying"
    assert cli.main([*COMMAND.split(), str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    return read_recording(folder, ROBOT)


@pytest.mark.slow
def test_each_tick_says_where_the_box_is_and_some_are_picked_up(recording: Recording) -> None:
    assert recording.box is not None
    assert recording.place is not None
    for first, _ in recording.spans:
        assert recording.box[first, 2] == pytest.approx(STANDS, abs=0.01)
        assert 0.25 < np.linalg.norm(recording.box[first, :2]) < 0.65
    assert (recording.box[:, 2] > 0.15).any(), "no box was picked up"


@pytest.mark.slow
def test_a_prior_of_carrying_judges_the_box_too_and_fits_no_other_task(
    folder: Path, recording: Recording, tmp_path: Path
) -> None:
    features = PriorFeatures(ROBOT, limbs_of(ROBOT), box=True)
    frames, _ = features.of(recording.raw[:5], recording.box[:5])  # type: ignore[index]
    assert frames.shape == (5, features.layout.size)
    assert frames[0, features.layout.slice("box")][2] == pytest.approx(STANDS, abs=0.01)
    with pytest.raises(ValueError, match="a robot and a box, and there is none"):
        features.of(recording.raw[:5])
    train = f"train prior --data {folder} --standing --steps 20 --frames 4 --layers 1 --width 16 --heads 2 --out"
    assert cli.main([*train.split(), str(tmp_path)]) == 0
    prior = load_prior(tmp_path / "prior.safetensors", ROBOT, limbs_of(ROBOT))
    assert prior.features.box
    settings = replace(PolicyTraining(), hidden=(16,), worlds=4, episode_seconds=0.4, generated=0.0)
    with pytest.raises(ConfigError, match="task speed has no box, and this prior knows a box"):
        environment(load_learned_task("speed", ROBOT), prior, Style(), settings, 4, 0)
    env = environment(load_learned_task("carry", ROBOT), prior, Style(), settings, 4, 0)
    env.reset()
    seen = env.observations["actor"][:, -15:]
    assert np.linalg.norm(seen[:, 4:6], axis=-1) == pytest.approx([0.45] * 4, abs=0.16)  # m to the box
    before = env.score.box
    for _ in range(env.limit):
        reward, done, _ = env.step(np.zeros((4, env.action_size)))
        assert np.isfinite(reward).all()
    assert done.all()
    assert env.score.box is not None
    assert not np.allclose(env.score.box, before), "a new episode has its box elsewhere"
    assert torch.isfinite(torch.from_numpy(env.score.ratio)).all()


@pytest.mark.slow
def test_demonstrations_are_of_what_was_told(recording: Recording) -> None:
    seen, targets = demonstrated(recording, ROBOT, GOALS["box"], 2, np.random.default_rng(0))
    assert len(seen) == len(targets)
    half = len(seen) // 2
    goal = GOALS["box"].mirror
    assert np.allclose(seen[half:, -15:], goal(seen[:half, -15:]), atol=1e-4)


def test_carrying_is_not_mixed_with_other_drills() -> None:
    assert cli.main(["collect", "--carry", "--skills", "--out", "x"]) == 2
    assert cli.main(["collect", "--only", "bow", "--out", "x"]) == 2


@pytest.mark.slow
def test_episodes_begin_before_a_box_or_with_one_in_the_arms() -> None:
    where, rngs = np.ones(8, bool), [np.random.default_rng(i) for i in range(8)]
    stands = AlongCarrying(ROBOT, 0.0, 0).draw(rngs, where)
    assert stands.objects is not None
    assert stands.objects[:, 0, 2] == pytest.approx(STANDS)
    begun = AlongCarrying(ROBOT, 1.0, 0).draw(rngs, where)
    assert begun.objects is not None
    boxes = begun.objects[:, 0]
    assert np.linalg.norm(boxes[:, :2], axis=-1) == pytest.approx([0.17] * 8, abs=0.06)  # m: at hand
    assert (boxes[:, 2] > 0.15).any(), "none is held"
    assert yaw_of(begun.orientation) == pytest.approx(0.0, abs=1e-6)  # an episode's frame is that of its first heading
