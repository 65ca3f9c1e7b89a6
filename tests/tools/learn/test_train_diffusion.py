from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import read_header
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.diffusion.model.checkpoint import load
from servoid.policy.diffusion.model.config import DenoiserConfig, TrainingObjective
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.objective import (
    Average,
    action_weight,
    draw_levels,
    level_weight,
    losses,
    rate_error,
    rising_levels,
)
from servoid.policy.diffusion.schedule import cosine_signal
from servoid.policy.diffusion.settings import load_settings
from servoid.policy.recording import read_recording
from servoid.stack.control import fleet
from servoid.tools.learn.settings import DiffusionTraining
from servoid.tools.learn.survival import closed_loop_survival
from servoid.tools.learn.trainers import diffusion
from servoid.tools.learn.trainers.diffusion import DiffusionTrainer
from servoid.tools.learn.trainers.logger import Logger

ROBOT = load_robot()
SHAPE: dict[str, Any] = {"layers": 1, "width": 16, "heads": 2}
CONFIG = DenoiserConfig(54, 20, **SHAPE)
QUICK = DiffusionTraining(minutes=1.0, steps=30, batch=16, evaluate_every=0.4, warmup_steps=5, text="", **SHAPE)


PLAIN = TrainingObjective(monotone=0.0)


class Measured:
    """Stands in for the closed loop: says what it is told, and remembers what it was shown."""

    def __init__(self, *survival: float) -> None:
        self.survival = list(survival)
        self.steps: list[int] = []

    def __call__(self, path: Path) -> Mapping[str, float]:
        self.steps.append(read_header(path)["results"]["step"])
        return {"survival": self.survival[min(len(self.steps), len(self.survival)) - 1]}


@pytest.fixture(scope="module")
def windows(synthetic_dataset: Path) -> Windows:
    return Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, CONFIG)


def trainer(windows: Windows, out: Path, survival: Measured, settings: DiffusionTraining = QUICK) -> DiffusionTrainer:
    return DiffusionTrainer(windows, ROBOT, settings, out, "made up", survival)


@pytest.mark.slow
def test_the_checkpoint_with_the_best_survival_is_kept_not_the_newest(windows: Windows, tmp_path: Path) -> None:
    measured = Measured(0.2, 0.9, 0.5)
    trainer(windows, tmp_path, measured).run()
    assert len(measured.steps) >= 3
    best = read_header(tmp_path / "best.safetensors")
    assert best["results"]["survival"] == 0.9
    assert best["results"]["step"] == measured.steps[1]
    assert read_header(tmp_path / "last.safetensors")["results"]["step"] == measured.steps[-1]
    assert best["data"] == "made up"
    assert best["licence"] == "Apache-2.0"
    assert load(tmp_path / "best.safetensors", ROBOT).config == CONFIG
    assert (tmp_path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert list((tmp_path / "tensorboard").glob("events*"))
    text = (tmp_path / "log.csv").read_text()
    assert "tokens_per_s" in text
    assert ",0.9,\n" in text  # no velocity error was measured


def test_ties_in_survival_go_to_the_lowervalidation_loss(windows: Windows, tmp_path: Path) -> None:
    run = trainer(windows, tmp_path, Measured(1.0))
    losses = iter([0.5, 0.3, 0.4, *[0.6] * 1000])
    run.validation_loss = lambda count=0: next(losses)  # type: ignore[method-assign]
    run.run()
    assert read_header(tmp_path / "best.safetensors")["results"]["validation_action_loss"] == 0.3


def test_an_interrupted_run_goes_on_where_it_stopped(windows: Windows, tmp_path: Path) -> None:
    first = trainer(windows, tmp_path, Measured(1.0))
    learn = first.learn

    def interrupted() -> dict[str, float]:
        if first.step == 12:
            raise KeyboardInterrupt
        return learn()

    first.learn = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        first.run()
    again = trainer(windows, tmp_path, Measured(1.0))
    assert again.resume()
    assert again.step == 12
    # The same batch, noise and optimiser state: the next step is the one that would have followed.
    assert again.learn() == pytest.approx(learn(), rel=1e-6)
    for a, b in zip(first.network.parameters(), again.network.parameters(), strict=True):
        torch.testing.assert_close(a, b)
    for name, weight in first.average.weights.items():
        torch.testing.assert_close(weight, again.average.weights[name])


def test_a_run_that_does_not_fit_is_not_resumed(windows: Windows, tmp_path: Path) -> None:
    assert not trainer(windows, tmp_path, Measured(1.0)).resume()
    trainer(windows, tmp_path, Measured(1.0)).save()
    with pytest.raises(ConfigError, match="width was 16, is 32"):
        trainer(windows, tmp_path, Measured(1.0), replace(QUICK, width=32)).resume()
    with pytest.raises(ConfigError, match="trained on made up, not on other"):
        DiffusionTrainer(windows, ROBOT, QUICK, tmp_path, "other", None).resume()
    (tmp_path / "resume.pt").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(ConfigError, match="cannot be resumed"):
        trainer(windows, tmp_path, Measured(1.0)).resume()


def test_a_resumed_run_keeps_the_emphasis_that_it_began_with(synthetic_dataset: Path, tmp_path: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    wide = replace(CONFIG, state_size=2 * CONFIG.state_size)
    first, other = (Windows(recording, ROBOT, wide, emphasis=5.0, seed=seed) for seed in (0, 1))
    trainer(first, tmp_path, Measured(1.0)).save()
    again = trainer(other, tmp_path, Measured(1.0))
    states, _ = first.held_out(4)[:2]
    assert not torch.equal(states, other.held_out(4)[0])
    assert again.resume()
    torch.testing.assert_close(again.windows.held_out(4)[0], states)


def test_training_lowers_the_loss_of_held_out_windows(windows: Windows, tmp_path: Path) -> None:
    run = trainer(windows, tmp_path, Measured(1.0), replace(QUICK, steps=0, batch=64, learning_rate=3e-3))
    run.average.decay = 0.9
    before = run.validation_loss()
    for _ in range(60):
        run.learn()
    assert run.validation_loss() < 0.7 * before


@pytest.mark.parametrize(
    ("shape", "training"),
    [({"actions": 1}, {}), ({"actions": 3}, {}), ({"levels": 4}, {}), ({}, {"far_actions": 0.0, "near_actions": 5})],
)
def test_survival_is_measured_of_a_network_that_the_shipped_settings_do_not_fit(
    synthetic_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    shape: dict[str, Any],
    training: dict[str, Any],
) -> None:
    short = replace(CONFIG, **shape)
    windows = Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, short)
    run = trainer(windows, tmp_path, Measured(1.0), replace(QUICK, **shape, **training))
    run.ship(tmp_path / "one.safetensors", {})
    shares: list[float] = []
    made = fleet.Fleet.__init__

    def noted(self: fleet.Fleet, *args: Any, **options: Any) -> None:
        shares.append(options["randomise"])
        made(self, *args, **options)

    monkeypatch.setattr(fleet.Fleet, "__init__", noted)
    assert 0.0 <= closed_loop_survival(tmp_path / "one.safetensors", 0.1, 2, 0)["survival"] <= 1.0
    assert shares == [0.5]  # robots drawn at random


def test_survival_that_cannot_be_measured_stops_the_run_before_it_trains(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named '{name}'")

    monkeypatch.setattr(diffusion, "import_module", missing)
    parser = argparse.ArgumentParser()
    diffusion.add_arguments(parser)
    args = parser.parse_args(["--data", str(tmp_path), "--out", str(tmp_path / "run")])
    with pytest.raises(ConfigError, match="survival cannot be measured"):
        diffusion.main(args)


def test_the_command_trains_from_a_folder_and_resumes(synthetic_dataset: Path, tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    diffusion.add_arguments(parser)
    options = [
        "--data",
        str(synthetic_dataset),
        "--out",
        str(tmp_path),
        "--layers",
        "1",
        "--width",
        "16",
        "--batch",
        "16",
    ]
    options += ["--threads", "1", "--survival-worlds", "0", "--evaluate-every", "0"]
    threads = torch.get_num_threads()
    try:
        assert diffusion.main(parser.parse_args([*options, "--steps", "3"])) == 0
        first = read_header(tmp_path / "best.safetensors")["results"]
        assert diffusion.main(parser.parse_args([*options, "--steps", "6"])) == 0
    finally:
        torch.set_num_threads(threads)
    second = read_header(tmp_path / "last.safetensors")["results"]
    assert second["step"] > first["step"]
    steps = [int(row.split(",")[0]) for row in (tmp_path / "log.csv").read_text().splitlines()[1:]]
    assert steps == sorted(steps)
    assert steps[-1] == second["step"]


def test_a_history_without_what_ran_is_refused(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    diffusion.add_arguments(parser)
    with pytest.raises(ConfigError, match="--history must be at least 2, not 1"):
        diffusion.main(parser.parse_args(["--data", str(tmp_path), "--out", str(tmp_path), "--history", "1"]))


def test_what_cannot_be_measured_is_refused_before_the_data_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parser = argparse.ArgumentParser()
    diffusion.add_arguments(parser)
    options = ["--data", str(tmp_path), "--out", str(tmp_path), "--threads", "1", "--text", ""]
    for committed in ("-1", "17"):
        with pytest.raises(ConfigError, match=f"--inference-delay must .* not {committed}"):
            diffusion.main(parser.parse_args([*options, "--committed", committed]))
    stabilised = replace(load_settings(), stabilization_level=9)
    monkeypatch.setattr("servoid.policy.diffusion.settings.load_settings", lambda: stabilised)
    with pytest.raises(ConfigError, match="stabilization_level must be at most 8"):
        diffusion.main(parser.parse_args([*options, "--levels", "8"]))


def test_the_past_is_clean_in_three_quarters_of_the_windows_and_half_share_one_level() -> None:
    states, actions = draw_levels(CONFIG, 400, torch.Generator().manual_seed(0), PLAIN)
    assert not states[:300, :4].any()
    assert not actions[:300, :3].any()
    assert (states[300:, :4] > 0).any(1).all()
    shared, independent = states[:200, 4:], states[200:, 4:]
    assert (shared == shared[:, :1]).all()
    assert shared.min() == 1
    assert shared.max() == 20
    assert torch.equal(actions[:200, -1:], shared[:, :1])  # actions share it too
    assert independent.float().std(1).min() > 1
    assert independent.min() == 0
    # Committed actions: none, one or two are clean, each a third of the time.
    clean = (actions[:200, 3:] == 0).sum(1)
    assert set(clean.tolist()) == {0, 1, 2}


def test_with_diffusion_forcing_alone_every_token_has_a_level_of_its_own() -> None:
    states, actions = draw_levels(
        CONFIG, 400, torch.Generator().manual_seed(0), TrainingObjective(monotone=0.0, forcing=1.0)
    )
    levels = torch.cat([states, actions], 1).float()
    assert levels.mean(0).sub(10).abs().max() < 1.5  # past and future alike
    assert (states[:, :4] > 0).any(0).all()
    assert (actions[:, :3] > 0).any(0).all()
    half = draw_levels(CONFIG, 400, torch.Generator().manual_seed(0), TrainingObjective(monotone=0.0, forcing=0.5))
    assert not half[0][:200, :4].any()
    assert (half[0][200:, :4] > 0).any(1).all()
    assert abs(torch.corrcoef(levels.T)[0, 1:]).max() < 0.25


def test_far_actions_count_less_and_past_ones_not_at_all() -> None:
    weight = action_weight(CONFIG, 8, 0.2)
    assert weight[:3].tolist() == [0, 0, 0]
    assert weight[3:11].tolist() == [1] * 8
    assert weight[11:].tolist() == pytest.approx([0.2] * 8)


def test_some_windows_have_levels_that_rise_as_gradual_and_rolling_schedules_do() -> None:
    generator = torch.Generator().manual_seed(0)
    states, actions = rising_levels(CONFIG, 500, generator)
    assert (states.diff(dim=1) >= 0).all()
    assert (actions.diff(dim=1) >= 0).all()
    assert states.min() == 0
    assert states.max() == 20
    between = ((states[:, 4:] > 0) & (states[:, 4:] < 20)).sum(1)
    steps = (between <= 1) & (states[:, 4] == 0) & (states[:, -1] == 20)
    assert 0.05 < steps.float().mean() < 0.5  # autoregressive
    assert (states[:, 4:].diff(dim=1).amax(1) <= 2).float().mean() > 0.1  # gentle
    together = (states[:, 1:] == actions).all(1).float().mean()
    assert 0.3 < together < 0.9  # the others are ahead or behind
    # In a batch they take the place of windows that share one level; the rest is as it was.
    plain = draw_levels(CONFIG, 400, torch.Generator().manual_seed(0), PLAIN)
    mixed = draw_levels(CONFIG, 400, torch.Generator().manual_seed(0), TrainingObjective(monotone=0.25))
    assert (mixed[0][:100, 4:].diff(dim=1) > 0).any(1).float().mean() > 0.5
    assert not mixed[0][:300, :4].any()
    assert torch.equal(plain[0][100:], mixed[0][100:])


def test_the_clip_of_min_snr_bounds_what_a_nearly_clean_token_weighs() -> None:
    signal = torch.as_tensor(cosine_signal(20), dtype=torch.float32)
    levels = torch.tensor([0, 1, 10, 20])
    assert level_weight(levels, signal, 0.0).tolist() == [0, 1, 1, 1]
    weight = level_weight(levels, signal, 5.0)
    assert weight[:2].tolist() == [0, 5]
    assert weight[2].item() == pytest.approx(1.0, abs=0.1)  # half of the variance is signal
    assert 0 < weight[3] < 1e-3


def test_the_action_rate_loss_sees_jitter_and_not_an_offset() -> None:
    target = torch.zeros(1, 5, 2)
    jitter = torch.tensor([0.1, -0.1, 0.1, -0.1, 0.1])[None, :, None].expand(1, 5, 2)
    noisy, weight = torch.full((1, 5), 7), torch.ones(1, 5)
    assert rate_error(target + 0.1, target, noisy, weight).item() == 0
    assert rate_error(jitter, target, noisy, weight).item() == pytest.approx(0.04)
    # A step away from an action that is given counts, whatever was predicted for that one.
    first = torch.tensor([[0, 7, 7, 7, 7]])
    assert rate_error(target + 0.1, target, first, weight).item() == pytest.approx(0.01 / 4)


def test_objectives_change_the_loss_and_nothing_else() -> None:
    network = Denoiser(CONFIG)
    signal = torch.as_tensor(cosine_signal(20), dtype=torch.float32)
    states, actions = torch.randn(32, 20, 54), torch.randn(32, 19, 20)

    def loss(**options: float) -> list[float]:
        generator = torch.Generator().manual_seed(3)
        parts = losses(network, states, actions, None, signal, generator, replace(PLAIN, **options))  # type: ignore[arg-type]
        return [part.item() for part in parts]

    plain = loss()
    assert loss(action_rate=0.5)[1] > plain[1]
    assert loss(action_rate=0.5)[0] == plain[0]
    assert loss(far_actions=0.0)[1] != plain[1]
    assert loss(min_snr=5.0) != plain
    assert loss(monotone=0.25) != plain


def test_objectives_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match=r"share of 0 to 0\.5, not 0\.8, with forcing 0\.25"):
        TrainingObjective(monotone=0.8)
    with pytest.raises(ValueError, match=r"monotone must be a share of 0 to 0, not 0\.25, with forcing 1"):
        TrainingObjective(forcing=1.0)
    with pytest.raises(ValueError, match=r"forcing must be a share of 0 to 1, not 1\.5"):
        TrainingObjective(forcing=1.5)
    with pytest.raises(ValueError, match="near_actions must be at least 1 tick"):
        TrainingObjective(near_actions=0)
    with pytest.raises(ValueError, match="min_snr must not be negative"):
        TrainingObjective(min_snr=-1.0)


def test_a_checkpoint_says_what_it_was_trained_for(windows: Windows, tmp_path: Path) -> None:
    options = {"min_snr": 5.0, "action_rate": 0.1, "monotone": 0.25, "forcing": 0.5, "far_actions": 0.0}
    settings = replace(QUICK, steps=5, **options)  # type: ignore[arg-type]
    trainer(windows, tmp_path, Measured(1.0), settings).run()
    training = read_header(tmp_path / "best.safetensors")["training"]
    assert options.items() <= training.items()
    assert training["near_actions"] == 8


def test_the_average_starts_quickly_and_then_forgets_slowly() -> None:
    network = Denoiser(CONFIG)
    average = Average(network, decay=0.99)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(1.0)
    start = network.norm.bias.mean().item()
    average.update(network)
    assert average.weights["norm.bias"].mean().item() == pytest.approx(start * (1 - 2 / 11))
    for _ in range(300):
        average.update(network)
    assert average.weights["norm.bias"].mean().item() == pytest.approx(start, abs=0.02)


def test_the_log_of_a_resumed_run_drops_what_was_logged_beyond_its_checkpoint(tmp_path: Path) -> None:
    with Logger(tmp_path, ("loss",)) as logger:
        for step in (1, 2, 3):
            logger.log(step, {"loss": float(step)})
    with Logger(tmp_path, ("loss",), step=2) as logger:
        logger.log(3, {"loss": 30.0})
        assert [(row["step"], float(row["loss"])) for row in logger.read()] == [("1", 1), ("2", 2), ("3", 30)]
        with pytest.raises(KeyError, match="no column 'speed'"):
            logger.log(4, {"speed": 1.0})
    np.testing.assert_equal(len(Logger(tmp_path, ("loss",)).read()), 0)
