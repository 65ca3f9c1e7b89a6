"""A tracker's training in a closed loop: what worlds are asked, where their things are, and what they follow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_planner import write_planner

from servoid.hw.config import ConfigError
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import resolve
from servoid.policy.motion.library import Library
from servoid.policy.tracker.network import load_tracker
from servoid.policy.tracker.observation import RESIDUAL
from servoid.stack.control.tracker import Followers
from servoid.tools.learn.envs.acts import NEAR, PLANS, WORDS
from servoid.tools.learn.envs.planned import PlannedTracking
from servoid.tools.learn.envs.score_term import AdversarialTerm
from servoid.tools.learn.prior_settings import ScoreSettings
from servoid.tools.learn.settings import TrackerTraining
from servoid.tools.learn.trainers.prior import learning_rival
from servoid.tools.learn.trainers.tracker import TrackerTrainer, environment

ROBOT = load_robot()
CLIPS = [Library(ROBOT)[name] for name in ("wave", "sit-down")]
N = 24


@pytest.fixture(scope="module")
def planner(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Settings of a closed loop with a planner whose plans stand, nearly."""
    folder = tmp_path_factory.mktemp("loop")
    checkpoint = write_planner(folder / "planner.safetensors", ROBOT)
    path = folder / "loop.yaml"
    path.write_text(f"checkpoint: {checkpoint}\ntracker: tracker\nwalker: ''\nframes: 6\n", encoding="utf-8")
    return str(path)


def _environment(planner: str, n: int = N, **changes: object) -> PlannedTracking:
    settings = replace(
        TrackerTraining(), planner=planner, hidden=(16,), horizon=6, mini_batches=2, worlds=n, hardest_push=0.0,
        randomised=0.0, samples=1e6, **changes,
    )  # fmt: skip
    env = PlannedTracking(ROBOT, n, None, settings, 0, CLIPS)
    env.reset()
    return env


def test_worlds_are_asked_for_acts_whose_things_are_where_they_were_drawn(planner: str) -> None:
    env = _environment(planner, near=1.0)
    acts, truth = env.motions._acts, env.fleet.truth
    names = [acts.name(i) for i in range(N)]
    assert set(names) == {*PLANS, WORDS}
    for i, name in enumerate(names):
        seat, bag = (np.linalg.norm(truth.objects[i, k, :2] - truth.position[i, :2]) for k in (0, 1))
        assert (bag < 0.25) == (name in ("punch", "kick"))
        assert (seat < 0.25) == (name == "sit,rise")
        if name == "sit,rise":
            low, high = NEAR[name]["sit"]
            assert low - 0.01 < seat < high + 0.01
            assert abs(float(truth.yaw[i])) < 0.7, "it has its back to the seat"
    told = {name: acts.told[i] for i, name in enumerate(names)}
    assert told[WORDS].text in CLIPS[0].about.captions, "sentences of what begins and ends upright"
    # What is asked of a place leads to the thing, seen from the robot.
    i = names.index("reach")
    goal = acts.told[i].goal
    assert goal is not None
    assert 0.05 <= float(np.linalg.norm(goal)) <= 0.2


def test_plans_go_on_from_what_each_world_did_and_a_fall_ends_its_episode(planner: str) -> None:
    env = _environment(planner)
    for _ in range(8):
        reward, done, _ = env.step(np.zeros((N, 20)))
    assert not done.any()
    assert (reward > 0.0).all(), "whoever stands as its plan does is rewarded, whatever it was asked"
    ahead = env.reference.frames(np.arange(4)).position
    assert np.ptp(ahead[:, 3], 0).max() > 1e-4, "each world has a plan of its own"
    before = env.motions.measures
    hit = np.zeros((N, 2))
    hit[3] = [1.5, 0.0]
    env.fleet.worlds.push(hit)
    fell = np.zeros(N, bool)
    for _ in range(60):
        _, done, late = env.step(np.zeros((N, 20)))
        fell |= done & ~late
        assert np.isfinite(env.observations["critic"]).all()
        if fell[3]:
            break
    assert np.flatnonzero(fell).tolist() == [3]
    assert env.ticks[3] == 0, "it begins anew"
    assert up_vector(env.fleet.truth.orientation[3])[2] > 0.99
    assert min(env.motions.measures[name] - before[name] for name in before) < 0.0


@pytest.mark.slow
def test_what_is_trained_so_is_a_tracker_of_any_reference(planner: str, tmp_path: Path) -> None:
    env = _environment(planner, n=6)
    trainer = TrackerTrainer(env, env.settings, tmp_path)
    row = trainer.learn()
    assert np.isfinite(list(row.values())).all()
    assert {"upright/reach", "upright/sit-rise", "walking"} <= row.keys()
    trainer.ship(tmp_path / "tracker.safetensors", {})
    assert load_tracker(tmp_path / "tracker.safetensors", ROBOT)[1].clips


def test_a_pupil_of_key_points_walks_itself_and_is_taught_on_plans(planner: str, tmp_path: Path) -> None:
    walks = tmp_path / "walks.yaml"
    walks.write_text(
        Path(planner).read_text(encoding="utf-8").replace("walker: ''", "walker: expert"), encoding="utf-8"
    )
    assert _environment(str(walks), n=2).motions._walker is not None
    env = _environment(str(walks), n=2, points=True, teacher="tracker")
    assert env.motions._walker is None
    teacher = Followers(ROBOT, "tracker", "expert", (2,))
    for _ in range(4):
        expected = teacher(env.fleet.state, env.fleet.applied, env.reference)
        np.testing.assert_allclose(ROBOT.home + RESIDUAL * env.taught, expected, atol=1e-9)
        _, done, _ = env.step(env.taught)
        assert not done.any()


@pytest.mark.slow
def test_half_of_the_reward_is_a_discriminators_that_learns_where_it_is_asked_for(
    planner: str, synthetic_dataset: Path, tmp_path: Path
) -> None:
    from servoid.policy.priors.score_matching.model import Style, load_prior
    from servoid.sim.kinematics import limbs_of

    plain, styled = _environment(planner, n=4), _environment(planner, n=4)
    prior = load_prior(resolve("prior"), ROBOT, limbs_of(ROBOT))
    rival = learning_rival(synthetic_dataset, prior, 0)
    styled.style = AdversarialTerm(prior, Style(), 4, ScoreSettings(), 0, rival)
    still = np.zeros((4, 20))
    for _ in range(3):
        followed, both = plain.step(still)[0], styled.step(still)[0]
    liked = 2.0 * both - followed
    assert (liked >= -1e-9).all(), "the same motion, and half of what it is rewarded by"
    assert (liked > 0.0).any()
    before = [weight.clone() for weight in rival.discriminator.parameters()]
    styled.learn()
    assert any((a != b).any() for a, b in zip(before, rival.discriminator.parameters(), strict=True))
    with pytest.raises(ConfigError, match="--adversarial needs --planner"):
        environment(ROBOT, None, TrackerTraining(), [], synthetic_dataset)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"near": 1.5}, "near must be 0 to 1"),
        ({"words": -0.1}, "words must be 0 to 1"),
        ({"clip_share": 0.0}, "clip_share must not be 0"),
    ],
)
def test_settings_of_a_closed_loop_that_cannot_be_are_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(TrackerTraining(), planner="closd", **changes)


def test_a_planner_that_is_not_there_is_named() -> None:
    with pytest.raises(ConfigError, match="nowhere"):
        _environment("nowhere", n=1)
