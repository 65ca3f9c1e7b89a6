"""A motion prior: what it knows, what it refuses, and what it generates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_prior import SMALL, trainer, write_prior
from synthetic_recording import write_dataset

from servoid.hw.config import ConfigError
from servoid.hw.geometry import up_vector, yaw_of
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.limbs import Limb, Limbs
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.features import raw_layout
from servoid.policy.priors.score_matching.generate import generate, starts, upright
from servoid.policy.priors.score_matching.judged import manner_of
from servoid.policy.priors.score_matching.model import Prior, Style, load_prior
from servoid.policy.priors.score_matching.score import RunningMean, Score, likeness
from servoid.policy.priors.score_matching.styles import StyleClassifier
from servoid.policy.priors.score_matching.windows import PriorWindows, WindowSelection
from servoid.policy.recording import DatasetError
from servoid.sim.kinematics import limbs_of
from servoid.tools.learn.prior_settings import PriorTraining
from servoid.tools.learn.trainers.prior import read_by_style

ROBOT = load_robot()


@pytest.fixture(scope="module")
def styled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prior of two styles."""
    data = tmp_path_factory.mktemp("styles")
    for seed, style in enumerate(("high", "low")):
        write_dataset(data / style, ROBOT, episodes=4, ticks=60, seed=seed)
    return write_prior(data, tmp_path_factory.mktemp("prior"))


@pytest.fixture(scope="module")
def prior(styled: Path) -> Prior:
    return load_prior(styled, ROBOT, limbs_of(ROBOT))


def windows(prior: Prior, count: int = 64) -> torch.Tensor:
    torch.manual_seed(0)
    return prior.decode(torch.randn(count, prior.config.frames, prior.config.size))


def changed(path: Path, out: Path, **more: Any) -> Path:
    """The checkpoint with another header."""
    head, tensors = checkpoint.read(path)
    checkpoint.write(out, tensors, {**head, **more})
    return out


def test_training_makes_it_tell_data_from_noise(synthetic_dataset: Path, tmp_path: Path) -> None:
    made = trainer(synthetic_dataset, tmp_path, replace(SMALL, steps=120, width=64, learning_rate=3e-3, average=0.9))
    made.start(resume=False)
    first = made.learn()["loss"]
    made.run()
    found = load_prior(made.best_path, ROBOT)
    known = found.decode(made.windows.held_out(64)[0])
    score = Score(found, Style(), 0)
    assert score(known).shape == (64, 3)
    assert score(known).mean() < 0.8 * score(windows(found)).mean()
    assert made.held_out()["error"] < 0.9 * first
    assert found.header["results"]["step"] == 120


def test_styles_are_composed_by_the_body(prior: Prior) -> None:
    """Upper features are those of one style and lower ones those of the other."""
    noisy, levels = windows(prior, 8), torch.full((8,), 4)
    high, low = (prior.noise(noisy, levels, Style(name, name)) for name in ("high", "low"))
    both = prior.noise(noisy, levels, Style.parse("high+low"))
    lower = torch.from_numpy(prior.features.lower)
    assert torch.equal(both[..., lower], low[..., lower])
    assert torch.equal(both[..., ~lower], high[..., ~lower])
    assert not torch.allclose(high, low)
    free = prior.noise(noisy, levels, Style())
    guided = prior.noise(noisy, levels, Style.parse("low", 2.0))
    assert torch.allclose(guided, free + 2.0 * (low - free), atol=1e-5)


def test_a_classifier_tells_styles_by_the_halves_that_show_them(prior: Prior) -> None:
    """Two styles that differ in what the arms do: the legs cannot tell them."""
    torch.manual_seed(0)
    tells, arms = StyleClassifier(prior.config, prior.features), torch.from_numpy(~prior.features.lower)
    optimiser, generator = torch.optim.Adam(tells.parameters(), 3e-3), torch.Generator().manual_seed(0)

    def drawn(count: int) -> tuple[torch.Tensor, torch.Tensor]:
        styles = torch.randint(1, 3, (count,), generator=generator)
        shift = (styles[:, None, None] - 1.5) * 2.0 * arms
        return torch.randn(count, prior.config.frames, prior.config.size, generator=generator) + shift, styles

    for _ in range(80):
        optimiser.zero_grad()
        tells.loss(*drawn(64), generator).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    seen, styles = drawn(400)
    whole, upper, lower = (tells.told(seen) == styles).float().mean(1).tolist()
    assert min(whole, upper) > 0.95
    assert lower < 0.65
    first = seen[styles == 1]
    assert tells.shares(first, 1, 1)["style"] > 0.95
    composed = tells.shares(first, 1, 2)
    assert composed["upper_style"] > 0.95
    assert composed["style"] <= composed["lower_style"]  # both halves must show theirs


def test_a_prior_of_styles_tells_which_is_shown_and_keeps_that(prior: Prior) -> None:
    assert prior.classifier is not None
    found = prior.shown(windows(prior), Style.parse("high+low"))
    assert set(found) == {"style", "upper_style", "lower_style"}
    assert prior.shown(windows(prior), Style()) == {}
    with pytest.raises(ConfigError, match="not in this prior"):
        prior.shown(windows(prior), Style.parse("none"))
    assert {"style", "upper_style", "lower_style"} <= set(prior.header["results"])


def test_an_unknown_style_is_named(prior: Prior) -> None:
    with pytest.raises(ConfigError, match=r"style 'zombie'.*high, low"):
        Score(prior, Style.parse("zombie"), 0)


def test_a_window_with_a_nan_is_refused(prior: Prior) -> None:
    bad = windows(prior)
    bad[3, 1, 5] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        Score(prior, Style(), 0)(bad)


def test_the_manner_of_a_run_is_judged_from_when_it_has_settled() -> None:
    """A robot that stands is unlike the data of walks, and has no amplitude."""
    found = load_prior(checkpoint.resolve("prior"), ROBOT, limbs_of(ROBOT))
    layout = raw_layout(len(ROBOT.joints))
    stands = np.zeros((120, layout.size), np.float32)
    stands[:, layout.slice("position")] = ROBOT.home
    stands[:, layout.slice("gravity")] = [0.0, 0.0, -1.0]
    stands[:, layout.slice("displacement")] = [0.0, 0.0, ROBOT.standing_height]
    manner = manner_of(stands, found)
    assert manner["prior_error"] > 2.0
    assert manner["amplitude"] < 1e-6
    assert np.isnan(manner["cadence"])
    assert manner_of(stands[:100], found) == {}  # two seconds


def test_a_random_level_is_one_error_a_window(prior: Prior) -> None:
    assert Score(prior, Style(), 0, random_level=True)(windows(prior)).shape == (64, 1)


def test_generated_windows_depend_on_the_seed_alone(prior: Prior) -> None:
    a, b, c = (generate(prior, 3, Style(), seed) for seed in (1, 1, 2))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)
    assert torch.equal(generate(prior, 2, Style(), 1), a[:2])
    assert a.shape == (3, prior.config.frames, prior.config.size)
    start = starts(a.numpy(), prior.features, 0.04)
    assert start.joints is not None
    assert (start.joints >= ROBOT.lower).all()
    assert (start.joints <= ROBOT.upper).all()
    assert start.position is not None
    assert np.isnan(start.position[:, 2]).all()  # put down on the ground


def test_an_upright_quaternion_tilts_as_gravity_says() -> None:
    gravity = np.random.default_rng(0).normal(size=(20, 3))
    quaternion = upright(gravity)
    assert np.allclose(-up_vector(quaternion), gravity / np.linalg.norm(gravity, axis=1, keepdims=True))
    assert np.allclose(yaw_of(quaternion), 0.0)


def test_the_running_mean_is_of_all_errors_until_it_freezes() -> None:
    mean = RunningMean(2, freeze_after=30)
    first = mean(np.full((20, 2), [2.0, 4.0]))
    assert np.allclose(first, [2.0, 4.0])
    assert np.allclose(mean(np.full((20, 2), [4.0, 0.0])), [3.0, 2.0])
    assert np.allclose(mean(np.full((20, 2), 100.0)), [3.0, 2.0])
    assert np.allclose(likeness(np.array([[3.0, 2.0], [0.0, 0.0]]), np.array([3.0, 2.0]), 6.0), [np.exp(-6.0), 1.0])


def test_what_does_not_fit_is_refused(styled: Path, tmp_path: Path) -> None:
    head, _ = checkpoint.read(styled)
    layout = [["velocity", 3], *head["prior_layout"][2:]]
    others = [
        ({"rate": 100}, "100 ticks a second"),
        ({"joints": list(ROBOT.names[::-1])}, "joints do not fit"),
        ({"prior_layout": layout}, "layout is not this program's"),
        ({"results": {"step": 0}}, "0 steps"),
        ({"results": {"step": 10}}, "interrupted before it was measured"),
        ({"kind": "diffusion"}, "a prior network is needed"),
        ({"config": {**head["config"], "frames": 1}}, "frames must be at least 2"),
    ]
    for number, (change, message) in enumerate(others):
        with pytest.raises(CheckpointError, match=message):
            load_prior(changed(styled, tmp_path / f"{number}.safetensors", **change), ROBOT)
    limbs = limbs_of(ROBOT)
    arm = limbs.limbs[0]
    longer = Limbs((Limb(arm.joints, arm.anchors, arm.axes, arm.tip * 1.1), *limbs.limbs[1:]))
    with pytest.raises(CheckpointError, match="limbs are not those of op3"):
        load_prior(styled, ROBOT, longer)


def test_data_without_motion_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path / "short", ROBOT, episodes=3, ticks=1)
    with pytest.raises(DatasetError, match="no episode has the 7 ticks of a window"):
        trainer(tmp_path / "short", tmp_path / "out")
    write_dataset(tmp_path / "single", ROBOT, episodes=1, ticks=60)
    with pytest.raises(DatasetError, match="one episode alone"):
        trainer(tmp_path / "single", tmp_path / "out")


def test_less_of_the_data_is_learned_from_and_as_much_measured_on(synthetic_dataset: Path, tmp_path: Path) -> None:
    recordings, made = read_by_style(synthetic_dataset, ROBOT), trainer(synthetic_dataset, tmp_path)
    whole, span = made.windows, (made.config.frames - 1) * made.config.stride
    few = PriorWindows(recordings, made.features, made.config, WindowSelection(seconds=3.0))
    ticks = 3 * ROBOT.rate
    assert ticks - 3 * span <= len(few.training) < ticks - span  # in pieces of two episodes
    assert set(few.training.tolist()) < set(whole.training.tolist())
    assert torch.equal(few.validation, whole.validation)
    with pytest.raises(DatasetError, match=r"seconds 0\.1: shorter than"):
        PriorWindows(recordings, made.features, made.config, WindowSelection(seconds=0.1))


def test_windows_in_which_nothing_moves_are_left_out(synthetic_dataset: Path, tmp_path: Path) -> None:
    recordings, made = read_by_style(synthetic_dataset, ROBOT), trainer(synthetic_dataset, tmp_path)
    whole, span = made.windows, (made.config.frames - 1) * made.config.stride
    recording = recordings[""]
    joints = raw_layout(len(ROBOT.joints)).slice("position")
    recording.raw[: len(recording.raw) // 2, joints] = ROBOT.home
    moving = PriorWindows(recordings, made.features, made.config, WindowSelection(moving=0.02))
    kept = moving.training.numpy()
    assert 0 < len(kept) < len(whole.training)
    for last in (kept[0], kept[-1]):
        assert np.ptp(recording.raw[last - span : last + 1, joints], axis=0).max() >= 0.02
    with pytest.raises(DatasetError, match="and a joint comes 9 rad far"):
        PriorWindows(recordings, made.features, made.config, WindowSelection(moving=9.0))
    with pytest.raises(ValueError, match="moving must not be negative"):
        PriorTraining(moving=-0.1)


def test_folders_of_datasets_are_styles(tmp_path: Path, synthetic_dataset: Path) -> None:
    write_dataset(tmp_path / "data" / "wide", ROBOT, episodes=2, ticks=30)
    assert list(read_by_style(tmp_path / "data", ROBOT)) == ["wide"]
    assert list(read_by_style(synthetic_dataset, ROBOT)) == [""]


def test_the_shipped_prior_knows_motion_of_this_robot() -> None:
    found = load_prior(checkpoint.resolve("prior"), ROBOT, limbs_of(ROBOT))
    results = found.header["results"]
    assert results["reversed_error"] > 5.0 * results["error"]
    drawn = generate(found, 8, Style(), 0)
    still = drawn[:, -1:].expand_as(drawn)
    score = Score(found, Style(), 0)
    assert score(still).mean() > 2.0 * score(drawn).mean()
    speeds, cadences = found.manner["speed"], found.manner["cadence"]
    assert len(speeds) == len(cadences) >= 3


def test_the_shipped_styles_are_told_and_compose() -> None:
    """Windows drawn with the arms of one style on the legs of another show both."""
    found = load_prior(checkpoint.resolve("styles", ROBOT), ROBOT, limbs_of(ROBOT))
    assert found.header["results"]["style"] > 0.95
    both = Style.parse("zombie+wide")
    shown = found.shown(generate(found, 32, both, 0), both)
    assert min(shown["upper_style"], shown["lower_style"]) > 0.9
    assert found.shown(generate(found, 32, Style.parse("zombie"), 0), both)["lower_style"] < 0.5
