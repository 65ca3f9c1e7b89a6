"""The expert's training: its world, what it saves, how it goes on, and what it exports."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.mlp import Mlp
from servoid.policy.tracker.observation import TrackerObservation
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.envs.tracking import Tracking, _draw
from servoid.tools.learn.settings import load_settings
from servoid.tools.learn.trainers.expert import Trainer, _observations, forget_after, plot

ROBOT = load_robot()
SETTINGS = replace(load_settings(), hidden=(32, 16), horizon=6, mini_batches=2, episode_seconds=1.0)


def trainer(out: Path, fresh: bool = False, samples: float = 1e6) -> Trainer:
    out.mkdir(exist_ok=True)
    return Trainer(Tracking(ROBOT, 8, None, SETTINGS), out, samples, fresh)


def rows(out: Path) -> list[float]:
    with (out / "progress.csv").open() as file:
        return [float(row["samples"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trainer]:
    out = tmp_path_factory.mktemp("expert")
    first = trainer(out)
    before = first.ppo.actor.mlp[0].weight.detach().clone()
    for _ in range(2):
        row = first._iteration()
        assert all(math.isfinite(value) for value in row.values())
    assert not (first.ppo.actor.mlp[0].weight == before).all()
    first._save()
    return out, first


def test_two_iterations_are_saved_with_their_curve(trained: tuple[Path, Trainer]) -> None:
    out, first = trained
    assert first.samples == 2 * 6 * 8
    assert rows(out) == [48, 96]
    assert (out / "progress.png").stat().st_size > 1000
    assert list(out.glob("events.out.tfevents.*"))


def test_it_goes_on_where_it_was(trained: tuple[Path, Trainer]) -> None:
    out, first = trained
    again = trainer(out)
    assert again.samples == first.samples
    for ours, theirs in zip(again.ppo.actor.state_dict().values(), first.ppo.actor.state_dict().values(), strict=True):
        assert (ours == theirs).all()
    again._iteration()
    assert again.samples == 144
    assert rows(out) == [48, 96, 144]
    # Killed here, before it saved: the next call repeats that iteration, and the curve does not count it twice.
    assert trainer(out).samples == 96
    assert rows(out) == [48, 96]


def test_the_export_acts_as_the_trained_actor(trained: tuple[Path, Trainer]) -> None:
    import torch

    out, first = trained
    network, head = Mlp.load(out / "expert.safetensors", "tracker", ROBOT, TrackerObservation(ROBOT).size)
    first.ppo.actor.eval()
    with torch.inference_mode():
        expected = first.ppo.actor(_observations(first.env)).numpy()
    np.testing.assert_allclose(network(first.env.actor), expected, atol=1e-4)
    assert np.abs(expected).max() > 0.01
    assert head["results"] == {"samples": 96}
    assert head["config"]["rewards"] == SETTINGS.rewards


def test_a_tracker_is_trained_further(trained: tuple[Path, Trainer], tmp_path: Path) -> None:
    """With --init the run begins with what the checkpoint does, less noise, and a critic that learns alone at first."""
    import torch

    out, _ = trained
    source = out / "expert.safetensors"
    env = Tracking(ROBOT, 8, None, SETTINGS)
    (tmp_path / "further").mkdir()
    further = Trainer(env, tmp_path / "further", 1e6, False, str(source))
    network, _ = Mlp.load(source, "tracker", ROBOT, TrackerObservation(ROBOT).size)
    further.ppo.actor.eval()
    with torch.inference_mode():
        acted = further.ppo.actor(_observations(env)).numpy()
    np.testing.assert_allclose(acted, network(env.actor), atol=1e-3)
    further.ppo.train_mode()
    critic = further.ppo.critic.mlp[0].weight.detach().clone()
    row = further._iteration()
    assert row["std"] == pytest.approx(np.mean(SETTINGS.noise), rel=1e-3)
    assert not torch.equal(further.ppo.critic.mlp[0].weight, critic)
    dense = [m for m in further.ppo.actor.mlp if hasattr(m, "weight")]
    for layer, (weight, _) in zip(dense, network.layers, strict=True):
        np.testing.assert_array_equal(layer.weight.detach().numpy().T, weight)
    further._save()
    _, head = Mlp.load(tmp_path / "further" / "expert.safetensors", "tracker", ROBOT, TrackerObservation(ROBOT).size)
    assert head["results"]["begun_with"]["results"] == {"samples": 96}
    again = Trainer(env, tmp_path / "further", 1e6, False, str(source))  # the same command goes on
    assert again.begun_with == further.begun_with
    again.samples = 600_000
    again._iteration()
    assert not torch.equal(again.ppo.actor.mlp[0].weight, further.ppo.actor.mlp[0].weight)  # the actor learns too


def test_a_tracker_with_other_layers_is_not_trained_further(trained: tuple[Path, Trainer], tmp_path: Path) -> None:
    env = Tracking(ROBOT, 2, None, replace(SETTINGS, hidden=(16, 16)))
    with pytest.raises(CheckpointError, match=r"hidden layers are \[32, 16\]"):
        Trainer(env, tmp_path, 1e6, False, str(trained[0] / "expert.safetensors"))


def test_a_folder_of_another_run_is_not_gone_on_with(trained: tuple[Path, Trainer], tmp_path: Path) -> None:
    """Neither for --init, which would be ignored, nor when the saved network has another shape."""
    out, _ = trained
    with pytest.raises(ConfigError, match=r"did not begin with .*--fresh"):
        Trainer(Tracking(ROBOT, 2, None, SETTINGS), out, 1e6, False, str(out / "expert.safetensors"))
    with pytest.raises(ConfigError, match=r"state\.pt: .*other inputs or layers.*--fresh"):
        Trainer(Tracking(ROBOT, 2, None, replace(SETTINGS, hidden=(16, 16))), out, 1e6, False)


def test_commands_of_training_are_spread_over_what_is_asked() -> None:
    """Backward while turning is where the tracker fell most, and top speed what it lacked: both must be seen often."""
    rng = np.random.default_rng(0)
    commands = np.array([_draw(rng, SETTINGS, ROBOT.walking) for _ in range(4000)])
    assert (commands >= ROBOT.walking.lower).all()
    assert (commands <= ROBOT.walking.upper).all()
    still = (commands == 0).all(1)
    mixed_back = (commands[:, 0] < 0) & (commands[:, 1:] != 0).all(1)
    fast = commands[:, 0] > 0.7 * ROBOT.walking.forward
    assert still.mean() == pytest.approx(SETTINGS.stand, abs=0.02)
    assert mixed_back.mean() > SETTINGS.backward
    assert fast.mean() > 0.08
    assert (commands[fast, 1:] == 0).all()  # no fast walking while turning or side-stepping


def test_a_fresh_start_leaves_no_curve_of_the_old_run(tmp_path: Path) -> None:
    trainer(tmp_path)._iteration()
    other = trainer(tmp_path, fresh=True)
    assert other.samples == 0
    assert not (tmp_path / "progress.csv").exists()


def test_a_budget_that_is_used_up_still_saves(tmp_path: Path) -> None:
    trainer(tmp_path, samples=0.5).learn(0.0)  # no iteration, and so no curve to draw
    assert (tmp_path / "state.pt").exists()
    assert (tmp_path / "expert.safetensors").exists()


def test_the_curve_keeps_what_was_saved(tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    forget_after(path, 5)  # nothing there is no error
    path.write_text("samples,reward\n1.0,2.0\n2.0,3.0\n3.0,4.0\n")
    forget_after(path, 2)
    assert path.read_text().split() == ["samples,reward", "1.0,2.0", "2.0,3.0"]
    plot(tmp_path / "none.csv", tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_a_world_learns_the_same_whatever_its_neighbours() -> None:
    """Commands, pushes, robots and noise come from the world's own stream, over falls and time-outs."""

    def lived(n: int) -> tuple[list[bytes], list[float]]:
        env, seen, rewards = Tracking(ROBOT, n, None, SETTINGS), [], []
        action = np.random.default_rng(0).standard_normal((70, 1, 20))
        for k in range(70):
            reward, done, _ = env.step(np.repeat(0.5 * action[k], n, 0))
            seen += [env.critic[0].tobytes(), done[0].tobytes()]
            rewards.append(reward[0])
        return seen, rewards

    (alone, reward), (among, their_reward) = lived(1), lived(3)
    assert alone == among
    np.testing.assert_allclose(reward, their_reward, rtol=1e-9)  # numpy sums in an order that depends on the shape


def test_falls_and_time_outs_end_episodes_and_only_time_outs_are_late() -> None:
    env = Tracking(ROBOT, 4, None, SETTINGS)
    ended, late = np.zeros(4, int), np.zeros(4, int)
    for _ in range(110):
        action = np.zeros((4, 20))
        action[0, 11] = 8.0  # a knee folded far beyond its reference: this one falls
        _, done, out = env.step(action)
        assert (done | ~out).all()
        ended += done
        late += out
        assert (env.ticks[done] == 0).all()
        assert np.isfinite(env.critic).all()
    assert env.limit == 50
    assert (late[1:] >= 1).all()
    assert ended[0] > late[0]


def test_the_actor_sees_nothing_of_the_truth_that_the_critic_sees() -> None:
    env = Tracking(ROBOT, 2, None, SETTINGS)
    assert env.actor.shape == (2, TrackerObservation(ROBOT).size)
    assert env.critic.shape[1] > env.actor.shape[1]
    np.testing.assert_array_equal(env.critic[:, : env.actor.shape[1]], env.actor)


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
