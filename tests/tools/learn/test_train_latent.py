"""`servoid train latent`, and a diffusion model that is trained on its latents."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.checkpoint import read_header
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.diffusion.model.action_space import load_action_space
from servoid.policy.diffusion.model.checkpoint import load
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.settings import load_settings
from servoid.policy.features import raw_mirror, raw_row
from servoid.policy.latent.actions import load_latents, same_latents
from servoid.policy.recording import read_recording
from servoid.stack.control.diffusion import diffusion_policy
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.latent_roundtrip import recoded_survival
from servoid.tools.learn.survival import closed_loop_survival
from servoid.tools.learn.trainers import diffusion, latent

ROBOT = load_robot()
SMALL = ["--size", "5", "--width", "24", "--layers", "1", "--batch", "32", "--threads", "1", "--evaluate-every", "0"]


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def train(verb: ModuleType, *options: object) -> None:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    assert verb.main(parser.parse_args([str(option) for option in options])) == 0


@pytest.fixture(scope="module")
def made(synthetic_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Latents of a second of training, measured in closed loop."""
    out = tmp_path_factory.mktemp("latent")
    before = torch.get_num_threads()
    world = ["--survival-worlds", 2, "--survival-seconds", 0.5]
    train(latent, "--data", synthetic_dataset, "--out", out, *SMALL, *world, "--steps", 40)
    torch.set_num_threads(before)
    return out / "latent.safetensors"


def test_the_file_says_what_was_measured(made: Path) -> None:
    head = read_header(made)
    assert head["kind"] == "latent"
    results = head["results"]
    assert {"reconstruction_rad", "prior_rad", "kl_nats", "survival", "expert_survival"} <= results.keys()
    assert results["expert_survival"] == 1.0
    assert head["training"]["beta"] == [0.01, 0.001]
    assert load_latents(made, ROBOT).size == 5
    assert (made.parent / "learning_curve.png").exists()


@pytest.mark.slow
def test_a_run_goes_on_and_another_network_is_refused(synthetic_dataset: Path, tmp_path: Path) -> None:
    options = ["--data", synthetic_dataset, "--out", tmp_path, *SMALL, "--survival-worlds", 0]
    train(latent, *options, "--steps", 4)
    first = read_header(tmp_path / "last.safetensors")["results"]["step"]
    train(latent, *options, "--steps", 8)
    assert read_header(tmp_path / "last.safetensors")["results"]["step"] > first
    with pytest.raises(ConfigError, match="size was 5, is 7"):
        train(latent, *options, "--steps", 8, "--size", 7)
    with pytest.raises(ConfigError, match="beta must be positive"):
        train(latent, *options, "--beta", 0, 1)


def test_the_expert_walks_through_latents_as_through_none(made: Path) -> None:
    """The same worlds and commands: what differs is what decoding loses, and these were hardly trained."""
    plain = recoded_survival(ROBOT, None, 3.0, 2, 0)
    through = recoded_survival(ROBOT, load_latents(made, ROBOT), 3.0, 2, 0)
    assert plain["survival"] == 1.0
    assert plain == recoded_survival(ROBOT, None, 3.0, 2, 0)
    assert through != plain


def test_windows_hold_the_latents_of_each_tick_and_its_state(made: Path, synthetic_dataset: Path) -> None:
    recording, latents = read_recording(synthetic_dataset, ROBOT), load_latents(made, ROBOT)
    config = DenoiserConfig(54, 5, layers=1, width=16, heads=2)
    windows = Windows(recording, ROBOT, config, latents=latents)
    present = windows.training[[3]]
    for mirrored in (False, True):
        _, actions = windows._gather(present, torch.tensor([mirrored]))
        tick, row = 2, int(present) + 2
        raw, target = recording.raw[row], recording.action[row]
        if mirrored:
            raw, target = raw_mirror(ROBOT)(raw), Mirror.joints(ROBOT)(target)
        np.testing.assert_allclose(actions[0, 3 + tick], latents.encode(raw, target), atol=1e-4)


def driven_by_the_present_state(path: Path) -> None:
    """Between two plans the fleet's latents are decoded with each tick's own state."""
    fleet = Fleet(ROBOT, 2, None)
    policy, space = (
        diffusion_policy(ROBOT, replace(load_settings(), checkpoint=str(path)), shape=(2,)),
        load_action_space(path, ROBOT),
    )
    fleet.reset(np.ones(2, bool))
    then = raw_row(fleet.observe())
    for tick in range(9):
        row = raw_row(fleet.observe())
        target = policy.act(fleet.state, fleet.applied, Instruction(np.zeros((2, 3))))
        if (plan := policy.plans.latest) is not None:
            planned = plan.actions[:, tick - plan.tick]
            np.testing.assert_array_equal(target, space.decode(row, planned))
        fleet.step(target)
    assert np.abs(target - space.decode(then, planned)).max() > 1e-3


@pytest.mark.slow
def test_a_diffusion_model_learns_to_plan_latents_and_carries_their_decoder(
    made: Path, synthetic_dataset: Path, tmp_path: Path
) -> None:
    options = ["--data", synthetic_dataset, "--out", tmp_path, "--latent", made, "--layers", 1, "--width", 16]
    options += ["--batch", 16, "--threads", 1, "--survival-worlds", 0, "--evaluate-every", 0, "--actions", 12]
    train(diffusion, *options, "--steps", 4)
    train(diffusion, *options, "--steps", 8)  # goes on
    model = load(tmp_path / "best.safetensors", ROBOT)
    assert model.config.action_size == 5
    assert model.config.action_horizon == 12
    assert same_latents(model.latents, load_latents(made, ROBOT))
    driven_by_the_present_state(tmp_path / "best.safetensors")
    measured = closed_loop_survival(tmp_path / "best.safetensors", 0.5, 2, 0)
    assert 0.0 <= measured["survival"] <= 1.0
    # What was learned in one space does not go on in another.
    begun = [
        "--data",
        synthetic_dataset,
        "--out",
        tmp_path / "on",
        "--init",
        tmp_path / "best.safetensors",
        *options[6:],
    ]
    with pytest.raises(ConfigError, match="its actions are not those of --latent"):
        train(diffusion, *begun, "--steps", 2)
