"""Runs that go on in their folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from test_train_diffusion import CONFIG, QUICK, ROBOT, Measured, trainer

from servoid.hw.config import ConfigError
from servoid.policy.checkpoint import read_header
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.latent.dataset import Demonstrations
from servoid.policy.recording import read_recording
from servoid.tools.learn.progress import ProgressLine
from servoid.tools.learn.settings import LatentTraining
from servoid.tools.learn.trainers import latent
from servoid.tools.learn.trainers.diffusion import DiffusionTrainer


@pytest.fixture(scope="module")
def windows(synthetic_dataset: Path) -> Windows:
    return Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, CONFIG)


@pytest.mark.parametrize(
    ("name", "value"),
    [("inference_delay", 1), ("far_actions", 0.0), ("monotone", 0.0), ("batch", 8), ("precision", "fp32")],
)
def test_a_run_goes_on_under_the_settings_that_it_began_with(
    windows: Windows, tmp_path: Path, name: str, value: Any
) -> None:
    trainer(windows, tmp_path, Measured(1.0)).save()
    was = getattr(QUICK, name)
    with pytest.raises(ConfigError, match=rf"other settings \({name} was {was}, is {value}\); use its options"):
        trainer(windows, tmp_path, Measured(1.0), replace(QUICK, **{name: value})).resume()


def test_a_run_goes_on_for_another_time_and_with_other_evaluations(windows: Windows, tmp_path: Path) -> None:
    trainer(windows, tmp_path, Measured(1.0)).save()
    longer = replace(QUICK, minutes=1.0, steps=40, evaluate_every=0.0)
    assert trainer(windows, tmp_path, Measured(1.0), longer).resume()


def test_a_run_of_a_program_that_did_not_keep_its_settings_goes_on(windows: Windows, tmp_path: Path) -> None:
    trainer(windows, tmp_path, Measured(1.0)).save()
    saved = torch.load(tmp_path / "resume.pt", weights_only=True)
    del saved["settings"]
    torch.save(saved, tmp_path / "resume.pt")
    assert trainer(windows, tmp_path, Measured(1.0), replace(QUICK, batch=8)).resume()


def test_latents_go_on_under_the_settings_that_they_began_with(synthetic_dataset: Path, tmp_path: Path) -> None:
    pairs = Demonstrations(read_recording(synthetic_dataset, ROBOT), ROBOT)

    def run(**settings: Any) -> latent.LatentTrainer:
        made = LatentTraining(size=5, width=24, layers=1, **settings)
        return latent.LatentTrainer(pairs, ROBOT, made, tmp_path, "", None)

    run().save()
    assert run(minutes=1.0).resume()
    with pytest.raises(ConfigError, match=r"beta was \(0.01, 0.001\), is \(0.1, 0.1\); change was 0.005, is 0.1"):
        run(beta=(0.1, 0.1), change=0.1).resume()


def test_a_checkpoint_says_what_it_was_begun_with_also_after_going_on(windows: Windows, tmp_path: Path) -> None:
    old = tmp_path / "old.safetensors"
    licensed = replace(QUICK, licence="CC-BY-4.0")
    DiffusionTrainer(windows, ROBOT, licensed, tmp_path, "old walks", None).ship(old, {"survival": 0.5})

    def run(source: str = "new walks") -> DiffusionTrainer:
        return DiffusionTrainer(windows, ROBOT, QUICK, tmp_path / "on", source, None)

    def header(of: DiffusionTrainer) -> dict[str, Any]:
        of.ship(tmp_path / "new.safetensors", of.progress)
        return read_header(tmp_path / "new.safetensors")

    first = run()
    first.start(resume=True, init=old)
    first.save()
    again = run()
    again.start(resume=True, init=old)
    for head in (header(first), header(again)):
        assert (head["data"], head["licence"]) == ("new walks", "Apache-2.0")
        begun = head["results"]["begun_with"]
        assert (begun["checkpoint"], begun["data"], begun["licence"]) == ("old.safetensors", "old walks", "CC-BY-4.0")
        assert begun["results"]["survival"] == 0.5
    with pytest.raises(ConfigError, match=r"did not start from .*new\.safetensors: use --no-resume"):
        run().start(resume=True, init=tmp_path / "new.safetensors")
    assert "begun_with" not in header(run())["results"]
    with pytest.raises(ConfigError, match="trained on new walks, not on other walks"):
        run("other walks").resume()


def test_the_time_that_is_left_is_that_of_this_calls_pace(capsys: pytest.CaptureFixture[str]) -> None:
    """A run that goes on must not divide what was done before by the seconds of this call, nor the reverse."""
    with ProgressLine(0.5) as line:
        line.trained(0.6, 60.0, "step 6")
        line.trained(0.7, 60.0, "step 7")
        line.note("measuring in closed loop ...")
    shown = capsys.readouterr().err
    assert "4 min left, step 6" in shown
    assert "3 min left, step 7" in shown
    assert "measuring in closed loop ..." in shown


def test_a_training_ends_with_the_next_command(
    windows: Windows, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer(windows, tmp_path, Measured(1.0), replace(QUICK, steps=2, evaluate_every=0.0)).run()
    shown = capsys.readouterr().err
    assert "measuring on held-out data ..." in shown  # where it would stand at 100 %
    command = f"servoid rollout walk --policy {tmp_path / 'best.safetensors'} --episodes 50"
    assert shown.splitlines()[-1] == f"next: {command}"
