"""The tracker's training: its world, what it saves, how it goes on, and what it exports."""

from __future__ import annotations

import csv
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoid.hw.config import ConfigError, load_yaml
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, read_header, resolve
from servoid.policy.mlp import Mlp
from servoid.policy.tracker.observation import TrackerObservation
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.envs.motions import _draw
from servoid.tools.learn.envs.tracking import Tracking, heads
from servoid.tools.learn.settings import TrackerTraining
from servoid.tools.learn.trainers.ppo import tensors
from servoid.tools.learn.trainers.tracker import TrackerTrainer

ROBOT = load_robot()
SETTINGS = replace(
    TrackerTraining(), hidden=(32, 16), horizon=6, mini_batches=2, episode_seconds=1.0, samples=1e6, worlds=8
)


def environment(n: int = 8) -> Tracking:
    env = Tracking(ROBOT, n, None, SETTINGS)
    env.reset()
    return env


def trainer(out: Path, resume: bool = True, init: Path | None = None, **changes: Any) -> TrackerTrainer:
    settings = replace(SETTINGS, **changes)
    made = TrackerTrainer(Tracking(ROBOT, settings.worlds, None, settings), settings, out)
    made.start(resume, init)
    return made


def rows(out: Path) -> list[float]:
    with (out / "log.csv").open() as file:
        return [float(row["step"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrackerTrainer]:
    out = tmp_path_factory.mktemp("tracker")
    first = trainer(out)
    first.prepare()
    before = first.ppo.actor.mlp[0].weight.detach().clone()
    row = first.learn()
    assert all(math.isfinite(value) for value in row.values())
    assert row["term/fall"] <= 0.0
    assert not (first.ppo.actor.mlp[0].weight == before).all()
    first = trainer(out, resume=False, samples=96.0, evaluate_every=0.0)
    first.run()
    return out, first


def test_two_iterations_are_saved_with_their_curve(
    trained: tuple[Path, TrackerTrainer], capsys: pytest.CaptureFixture[str]
) -> None:
    out, first = trained
    assert first.step == 2 * 6 * 8
    assert rows(out)[-1] == 96
    assert (out / "learning_curve.png").stat().st_size > 1000
    assert list((out / "tensorboard").glob("events.out.tfevents.*"))
    assert "term/slip" in (out / "log.csv").read_text()
    trainer(out, samples=96.0, evaluate_every=0.0).run()  # the same command, where nothing is left to do
    said = capsys.readouterr().err
    assert "nothing is left to train" in said
    assert said.splitlines()[-1] == f"next: servoid rollout walk --policy {out / 'tracker.safetensors'} --episodes 50"


def test_it_goes_on_where_it_was(trained: tuple[Path, TrackerTrainer], tmp_path: Path) -> None:
    out, first = trained
    shutil.copytree(out, tmp_path / "copy")
    again = trainer(tmp_path / "copy", samples=144.0, evaluate_every=0.0)
    assert again.step == first.step
    for ours, theirs in zip(again.ppo.actor.state_dict().values(), first.ppo.actor.state_dict().values(), strict=True):
        assert (ours == theirs).all()
    again.run()
    assert again.step == 144
    assert rows(tmp_path / "copy")[-1] == 144


def test_the_export_acts_as_the_trained_actor(trained: tuple[Path, TrackerTrainer]) -> None:
    import torch

    out, first = trained
    network, head = Mlp.load(out / "tracker.safetensors", "tracker", ROBOT, TrackerObservation(ROBOT, clips=True).size)
    first.ppo.actor.eval()
    with torch.inference_mode():
        expected = first.ppo.actor(tensors(first.env)).numpy()
    still = heads(ROBOT)
    acted = network(first.env.observations["actor"])
    np.testing.assert_allclose(acted[:, ~still], expected[:, ~still], atol=1e-4)
    assert (acted[:, still] == 0.0).all(), "the head follows the reference alone"
    assert still.sum() == 2
    assert np.abs(expected).max() > 0.01
    assert head["results"]["samples"] == 96
    assert head["config"]["rewards"] == SETTINGS.rewards
    assert head["training"]["hidden"] == [32, 16]
    # What was used is in the folder, as a file that another run takes.
    assert load_yaml(out / "settings.yaml", TrackerTraining) == replace(SETTINGS, samples=96.0, evaluate_every=0.0)


def test_a_tracker_is_trained_further(trained: tuple[Path, TrackerTrainer], tmp_path: Path) -> None:
    """With --init the run begins with what the checkpoint does, less noise, and a critic that learns alone at first."""
    import torch

    out, _ = trained
    source = out / "tracker.safetensors"
    further = trainer(tmp_path / "further", init=source)
    network, _ = Mlp.load(source, "tracker", ROBOT, TrackerObservation(ROBOT, clips=True).size)
    further.ppo.actor.eval()
    with torch.inference_mode():
        acted = further.ppo.actor(tensors(further.env)).numpy()
    np.testing.assert_allclose(further.env.acting * acted, network(further.env.observations["actor"]), atol=1e-3)
    further.prepare()
    critic = further.ppo.critic.mlp[0].weight.detach().clone()
    row = further.learn()
    assert row["std"] == pytest.approx(np.mean(SETTINGS.noise), rel=1e-3)
    assert not torch.equal(further.ppo.critic.mlp[0].weight, critic)
    dense = [m for m in further.ppo.actor.mlp if hasattr(m, "weight")]
    for layer, (weight, _) in zip(dense, network.layers, strict=True):
        np.testing.assert_array_equal(layer.weight.detach().numpy().T, weight)
    further.save()
    further.ship(tmp_path / "further.safetensors", further.progress)
    _, head = Mlp.load(tmp_path / "further.safetensors", "tracker", ROBOT, TrackerObservation(ROBOT, clips=True).size)
    assert head["results"]["begun_with"]["results"]["samples"] == 96
    again = trainer(tmp_path / "further", init=source)  # the same command goes on
    assert again.begun_with == further.begun_with
    again.step = 600_000
    again.prepare()
    again.learn()
    assert not torch.equal(again.ppo.actor.mlp[0].weight, further.ppo.actor.mlp[0].weight)  # the actor learns too


def test_a_tracker_with_other_layers_or_inputs_is_not_trained_further(
    trained: tuple[Path, TrackerTrainer], tmp_path: Path
) -> None:
    with pytest.raises(CheckpointError, match=r"hidden layers are \[32, 16\]; give --hidden 32 16"):
        trainer(tmp_path, init=trained[0] / "tracker.safetensors", hidden=(16, 16))
    with pytest.raises(CheckpointError, match="a tracker of the gait alone, which sees less"):
        trainer(tmp_path, init=resolve("expert"), hidden=(256, 128))


def test_training_begins_with_the_references_as_they_are(tmp_path: Path) -> None:
    import torch

    begun = trainer(tmp_path)
    begun.ppo.actor.eval()
    with torch.inference_mode():
        acted = begun.ppo.actor(tensors(begun.env)).numpy()
    assert 0.0 < np.abs(acted).max() < 0.1


def test_a_folder_of_another_run_is_not_gone_on_with(trained: tuple[Path, TrackerTrainer], tmp_path: Path) -> None:
    """Neither for --init, which would be ignored, nor under other settings, nor where an older program began it."""
    out, _ = trained
    with pytest.raises(ConfigError, match=r"did not start from .*--no-resume"):
        trainer(out, init=out / "tracker.safetensors")
    with pytest.raises(
        ConfigError, match=r"hidden was \(32, 16\), is \(16, 16\); hardest_push was 0.6, is 0.5.*--no-resume"
    ):
        trainer(out, hidden=(16, 16), hardest_push=0.5)
    (tmp_path / "state.pt").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"state\.pt: a run of an older program.*--no-resume.*--init"):
        trainer(tmp_path)


def test_an_interrupted_run_leaves_its_newest_network(tmp_path: Path) -> None:
    run = trainer(tmp_path, evaluate_every=0.0)
    learn = run.learn

    def interrupted() -> dict[str, float]:
        if run.step == 48:
            raise KeyboardInterrupt
        return learn()

    run.learn = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        run.run()
    assert read_header(tmp_path / "tracker.safetensors")["results"]["samples"] == 48
    assert trainer(tmp_path).step == 48


def test_commands_of_training_are_spread_over_what_is_asked() -> None:
    """Backward while turning is where the tracker fell most, and top speed what it lacked: both must be seen often."""
    rng = np.random.default_rng(0)
    commands = np.array([_draw(rng, SETTINGS, ROBOT.walking, ROBOT.walking) for _ in range(4000)])
    assert (commands >= ROBOT.walking.lower).all()
    assert (commands <= ROBOT.walking.upper).all()
    still = (commands == 0).all(1)
    mixed_back = (commands[:, 0] < 0) & (commands[:, 1:] != 0).all(1)
    fast = commands[:, 0] > 0.7 * ROBOT.walking.forward
    assert still.mean() == pytest.approx(SETTINGS.stand, abs=0.02)
    assert mixed_back.mean() > SETTINGS.backward
    assert fast.mean() > 0.08
    assert (commands[fast, 1:] == 0).all()  # no fast walking while turning or side-stepping


@pytest.mark.slow
def test_a_fresh_start_leaves_no_curve_of_the_old_run(tmp_path: Path) -> None:
    trainer(tmp_path, samples=48.0).run()
    assert rows(tmp_path)
    other = trainer(tmp_path, resume=False, samples=1.0)
    other.run()
    assert other.step == 48
    assert len(rows(tmp_path)) == 1


def test_a_world_learns_the_same_whatever_its_neighbours() -> None:
    """Commands, pushes, robots and noise come from the world's own stream, over falls and time-outs."""

    def lived(n: int) -> tuple[list[bytes], list[float]]:
        env, seen, rewards = environment(n), [], []
        action = np.random.default_rng(0).standard_normal((70, 1, 20))
        for k in range(70):
            reward, done, _ = env.step(np.repeat(0.5 * action[k], n, 0))
            seen += [env.observations["critic"][0].tobytes(), done[0].tobytes()]
            rewards.append(reward[0])
        return seen, rewards

    (alone, reward), (among, their_reward) = lived(1), lived(3)
    assert alone == among
    np.testing.assert_allclose(reward, their_reward, rtol=1e-9)  # numpy sums in an order that depends on the shape


def test_falls_and_time_outs_end_episodes_and_only_time_outs_are_late() -> None:
    env = environment(4)
    ended, late = np.zeros(4, int), np.zeros(4, int)
    for _ in range(110):
        action = np.zeros((4, 20))
        action[0, 11] = 8.0  # a knee folded far beyond its reference: this one falls
        _, done, out = env.step(action)
        assert (done | ~out).all()
        ended += done
        late += out
        assert (env.ticks[done] == 0).all()
        assert np.isfinite(env.observations["critic"]).all()
    assert env.limit == 50
    assert (late[1:] >= 1).all()
    assert ended[0] > late[0]


def test_the_actor_sees_nothing_of_the_truth_that_the_critic_sees() -> None:
    env = environment(2)
    actor, critic = env.observations["actor"], env.observations["critic"]
    assert actor.shape == (2, TrackerObservation(ROBOT, clips=True).size)
    assert critic.shape[1] > actor.shape[1]
    np.testing.assert_array_equal(critic[:, : actor.shape[1]], actor)


def test_a_label_is_not_changed_by_a_later_reset() -> None:
    fleet = Fleet(ROBOT, 2, None, threads=1)
    fleet.reset(np.ones(2, bool))
    fleet.observe()
    label = fleet.step(ROBOT.home + np.full((2, 20), 0.05))
    kept = label.copy()
    fleet.reset(np.ones(2, bool))
    np.testing.assert_array_equal(label, kept)
    np.testing.assert_array_equal(fleet.applied, np.tile(ROBOT.home, (2, 1)))


def test_noise_moves_the_robot_and_not_the_label() -> None:
    fleet = Fleet(ROBOT, 2, None, threads=1)
    fleet.reset(np.ones(2, bool))
    fleet.observe()
    target, noise = np.tile(ROBOT.home, (2, 1)), np.full((2, 20), 0.05)
    clean = fleet.step(target, noise)
    np.testing.assert_array_equal(clean, target)
    np.testing.assert_allclose(fleet.applied, target + noise)
    assert np.abs(fleet.step(target + 3.0) - fleet.applied).max() == 0.0  # without noise the label is what ran
    assert np.abs(fleet.applied - (target + noise)).max() <= ROBOT.limits.joint_speed * ROBOT.dt + 1e-9
