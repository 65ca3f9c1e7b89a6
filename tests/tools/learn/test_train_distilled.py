"""Training of a student by a teacher: `servoid train diffusion --distil`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_train_diffusion import CONFIG, ROBOT, Measured, trainer

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.diffusion.model.checkpoint import load
from servoid.policy.recording import read_recording


def test_a_student_begins_as_its_teacher_and_learns_from_it_alone(synthetic_dataset: Path, tmp_path: Path) -> None:
    windows = Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, CONFIG)
    first = trainer(windows, tmp_path / "teacher", Measured(1.0))
    first.learn()
    first.ship(tmp_path / "teacher.safetensors", {"step": 1})
    student = trainer(windows, tmp_path / "student", Measured(1.0))
    student.teach(tmp_path / "teacher.safetensors")
    student.start(False, tmp_path / "teacher.safetensors")
    for name, weight in load(tmp_path / "teacher.safetensors", ROBOT).denoiser.state_dict().items():
        torch.testing.assert_close(student.network.state_dict()[name], weight)
    loss = student.learn()["loss"]
    assert loss < 0.5 * first.learn()["loss"]  # what a teacher makes of two steps is hardly another thing than of one
    wider = Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, replace(CONFIG, width=32))
    with pytest.raises(ConfigError, match="--distil takes a model of the same shape"):
        trainer(wider, tmp_path / "wider", Measured(1.0)).teach(tmp_path / "teacher.safetensors")
