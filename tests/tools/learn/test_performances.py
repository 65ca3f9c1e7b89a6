"""What `servoid collect --skills` records, and how it becomes what a network is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.recording import Recording, read_recording
from servoid.policy.text.captions import MOTIONS
from servoid.policy.text.encoder import code_size
from servoid.policy.text.told import UNDER_WAY
from servoid.stack.skills.skill import clip_of, load_skills
from servoid.tools import cli
from servoid.tools.learn.collect.told import images_of, skills_in, told_of

ROBOT = load_robot()
COMMAND = "collect --skills --worlds 16 --frames 3000 --seconds 8 --threads 1 --json --out"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("collect") / "performances"
    assert cli.main([*COMMAND.split(), str(folder)]) == 0
    return read_recording(folder, ROBOT)


@pytest.mark.slow
def test_each_tick_says_what_was_told_and_for_how_long_and_the_robot_does_it(recording: Recording) -> None:
    assert recording.told is not None
    assert recording.clock is not None
    performs = recording.told >= len(MOTIONS)
    assert 0.2 < performs.mean() < 0.9
    assert not recording.command[performs].any()
    assert not recording.clock[~performs].any()
    goes_on = performs[1:] & (np.diff(recording.told) == 0) & (np.diff(recording.episode) == 0)
    steps = np.diff(recording.clock)[goes_on]
    assert np.isclose(steps[steps > 0.0], ROBOT.dt, atol=1e-5).all()
    skills = skills_in(recording, ROBOT)
    assert "wave" in skills
    assert "sit-on-seat" not in skills  # there is no seat
    off = []
    for number, name in enumerate(recording.skills):
        goals = clip_of(skills[name], ROBOT).joints
        rows = np.flatnonzero(recording.told == len(MOTIONS) + number)
        tick = np.round(recording.clock[rows] / ROBOT.dt).astype(int)
        during = tick < len(goals)
        off.append(((recording.action[rows[during]] - goals[tick[during]]) ** 2).mean(-1))
    assert np.sqrt(np.concatenate(off).mean()) < 0.12  # of targets off the clip that is told


@pytest.mark.slow
def test_windows_show_what_is_told_with_the_time_since_it_began(recording: Recording) -> None:
    skills = skills_in(recording, ROBOT)
    told = told_of(recording, ROBOT, skills)
    assert told is not None
    assert told.phrasings[len(MOTIONS) :] == tuple(skill.phrases for skill in skills.values())
    config = DenoiserConfig(54, 20, "words", code_size("words") + 4, width=16, clock=2, horizon=16)
    windows = Windows(recording, ROBOT, config, told)
    assert windows.captions is not None
    present = windows.training
    label, clock = told.label, told.clock
    assert (label[present] == label[present + 15]).all()  # none in which something else is told
    assert (clock[present + 15] >= clock[present]).all()
    walks = told.label < len(MOTIONS)
    assert clock[walks].min() == -UNDER_WAY
    assert clock[walks].max() == 0.0
    codes = windows.captions.of(present, present < 0)
    assert codes.shape[1] == windows.captions.size == config.text_size
    waves = codes[:, -4:].square().sum(1)  # sines and cosines of two waves
    assert np.allclose(waves, 2.0, atol=1e-4)


@pytest.mark.slow
def test_skills_take_a_network_with_a_clock_and_walks_take_none(recording: Recording) -> None:
    assert recording.skills
    assert replace(recording, told=None).skills == ()
    assert told_of(replace(recording, told=None), ROBOT, {}) is None


def test_a_mirror_image_is_told_as_the_other_side_and_a_one_sided_motion_has_none() -> None:
    skills = load_skills(ROBOT)
    names = ("kick-left", "crouch", "wave", "kick-right")
    images = images_of({name: clip_of(skills[name], ROBOT).joints for name in names}, ROBOT)
    assert images.tolist() == [3, 1, -1, 0]


def test_the_gait_alone_performs_no_skills(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["collect", "--skills", "--policy", "gait", "--out", str(tmp_path / "x")]) == 2
    assert "--skills goes with --policy expert" in capsys.readouterr().err
