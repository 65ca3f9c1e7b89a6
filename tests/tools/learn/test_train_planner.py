"""`servoid train planner`: takes, a training that goes on, and what it measures."""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, State
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import read_header
from servoid.policy.diffusion.prefix.config import PlannerShape
from servoid.policy.diffusion.prefix.dataset import HELD_OUT, PlanWindows, Sequences, ToldSentences
from servoid.policy.diffusion.prefix.frames import Frames, wrapped
from servoid.policy.features import Normaliser
from servoid.policy.motion.library import Library
from servoid.policy.text.captions import MOTIONS, NAMES
from servoid.policy.text.encoder import load_encoder
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.planner_settings import PlannerTraining
from servoid.tools.learn.takes.executed import execute
from servoid.tools.learn.takes.learned import learned_from
from servoid.tools.learn.takes.maker import TakeMaker, labels, told
from servoid.tools.learn.trainers import planner

ROBOT = load_robot("op3")
LIBRARY = Library(ROBOT)
CLIPS = [LIBRARY[name] for name in ("wave", "sit-down", "rise")]


def test_takes_go_from_clip_to_clip_without_a_jump_and_end_standing() -> None:
    maker = TakeMaker(ROBOT, CLIPS, np.random.default_rng(0))
    names = list(labels(CLIPS))
    seen: set[str] = set()
    for number, take in enumerate([*maker.clips(4, walking=0.0), *maker.clips(2, walking=1.0)]):
        order = [names[i] for i in take.label[np.r_[True, np.diff(take.label) != 0]]]
        seen |= set(order)
        assert order[-1] == "stand"
        assert all(after == "rise" for before, after in pairwise(order) if before == "sit-down")
        if number < 4:  # the gait itself is quicker
            assert np.abs(np.diff(take.joints, axis=0)).max() < ROBOT.limits.joint_speed * ROBOT.dt
        motion = Frames(ROBOT).motion(take.place, take.orientation, take.joints)
        assert np.linalg.norm(np.diff(take.place, axis=0), axis=1).max() < 0.03
        assert np.abs(wrapped(np.diff(motion.heading))).max() < 0.1
    assert {"wave", "sit-down", "rise", "stand"} <= seen
    assert any(motion.name in seen for motion in MOTIONS[1:]), "some clips begin from a walk that stops"


def test_walks_are_told_by_their_command_and_go_where_they_say() -> None:
    maker = TakeMaker(ROBOT, CLIPS, np.random.default_rng(0))
    forward = NAMES.index("forward")
    walks = maker.walks(8, 8.0)
    assert len(walks) == 8
    assert all(walk.ticks == 400 and (walk.label >= 0).all() for walk in walks)
    speeds = [np.diff(w.place[:, 0])[w.label[1:] == forward] / ROBOT.dt for w in walks]
    assert any(len(s) for s in speeds)


def test_what_leads_to_a_motion_is_called_like_it() -> None:
    assert told(np.array([3, -1, -1, 7, -1])).tolist() == [3, 7, 7, 7, NAMES.index("stand")]


def test_a_pose_that_nothing_leads_on_from_is_refused() -> None:
    with pytest.raises(ConfigError, match="no clip begins sitting"):
        TakeMaker(ROBOT, CLIPS[:2], np.random.default_rng(0))


def test_one_phrasing_names_one_motion() -> None:
    """A planner that was told two of them alike did the one where it was asked for the other."""
    wave = CLIPS[0]
    for caption in ("turn left on the spot", LIBRARY["rise"].about.captions[0]):
        twice = replace(wave, about=replace(wave.about, captions=(caption,)))
        with pytest.raises(ConfigError, match=f"clip 'wave': '{caption}'"):
            labels([LIBRARY["rise"], twice])


def test_takes_are_learned_from_as_they_are_executed_until_they_are_lost() -> None:
    """By the clips' own goals here. A robot that is made to give way is lost, and what is left ends before that."""
    frames = Frames(ROBOT)
    takes = TakeMaker(ROBOT, CLIPS[:1], np.random.default_rng(0)).clips(2, walking=0.0)
    takes = [replace(take, **{name: getattr(take, name)[:150] for name in ("place", "orientation", "joints", "label")})
             for take in takes]  # fmt: skip
    now = np.array([0])

    def follow(state: State, applied: Array, reference: Reference) -> Array:
        target = reference.frames(now).position[:, 0]
        follow_ticks.append(1)
        if len(follow_ticks) > 60:
            target[1, ROBOT.names.index("l_hip_pitch")] -= 1.2  # topples
            target[1, ROBOT.names.index("r_hip_pitch")] += 1.2
        return target

    follow_ticks: list[int] = []
    fleet = Fleet(ROBOT, 2, None, seed=0)
    kept = execute(takes, fleet, follow, frames)
    assert len(kept) == 2
    assert kept[0].take.ticks == len(kept[0].raw) == 150
    assert 30 < kept[1].take.ticks < 120
    np.testing.assert_array_equal(kept[0].take.joints[1:], takes[0].joints[:149], "what was to be reached by a tick")
    executed = frames.of_states(kept[0].raw)
    assert np.abs(executed.joints[20:] - takes[0].joints[20:150]).mean() < 0.08
    np.testing.assert_allclose(executed.place[:, 2], takes[0].place[:, 2], atol=0.03)


def test_recorded_walks_are_learned_from_too(synthetic_dataset: Path) -> None:
    frames, encoder = Frames(ROBOT), load_encoder("words")
    settings = PlannerTraining(
        clips=("wave",), clip_takes=10, walk_takes=10, walk_seconds=5.0, prefix=4, frames=6, licence="CC0-1.0"
    )
    alone, _, licence = learned_from(ROBOT, frames, encoder, settings)
    both, source, _ = learned_from(ROBOT, frames, encoder, settings, synthetic_dataset)
    assert both.count > alone.count
    assert "1 clips in 10 takes, 10 walks of the gait" in source
    assert f"{synthetic_dataset.name}:" in source
    assert licence.startswith("CC0-1.0 and ")


@pytest.mark.slow
def test_a_training_learns_goes_on_and_says_what_it_measured(tmp_path: Path) -> None:
    small = ["--layers", "1", "--width", "32", "--batch", "16", "--threads", "1", "--evaluate-every", "0",
             "--clips", "wave", "sit-down", "rise", "--clip-takes", "40", "--walk-takes", "10",
             "--walk-seconds", "8"]  # fmt: skip
    before, parser = torch.get_num_threads(), argparse.ArgumentParser()
    planner.add_arguments(parser)

    def trained(out: Path, *options: str) -> dict[str, Any]:
        assert planner.main(parser.parse_args([*small, "--out", str(out), *options])) == 0
        return read_header(out / "planner.safetensors")

    errors = [trained(tmp_path, "--steps", steps)["results"]["validation_loss"] for steps in ("20", "40")]
    begun = str(tmp_path / "planner.safetensors")
    other = trained(tmp_path / "other", "--init", begun, "--steps", "1", "--levels", "20", "--prefix", "10")
    torch.set_num_threads(before)
    assert (other["config"]["levels"], other["config"]["prefix"]) == (20, 10)
    assert other["results"]["validation_loss"] < errors[0], "its weights are those that were learned"
    head = read_header(tmp_path / "planner.safetensors")
    assert head["kind"] == "planner"
    assert head["results"]["step"] == 40
    assert 0.0 < errors[1] < errors[0], "it learns"
    assert 0.0 < head["results"]["target_error_m"] < 3.0
    assert "3 clips" in head["data"]


def test_what_follows_an_executed_prefix_is_what_was_wanted_and_starts_are_half_of_it() -> None:
    """Servos smooth what they are asked: plans of what was executed walk smaller and smaller steps, until they fall."""
    frames, shape, encoder = Frames(ROBOT), PlannerShape(prefix=6, frames=4), load_encoder("words")
    made, size = Sequences(), frames.layout.size
    for _ in range(HELD_OUT):
        made.frames.append(np.zeros((200, size), np.float32))
        made.wanted.append(np.ones((200, size), np.float32))
        made.label.append(np.repeat([0, 1], 100))
    told = {"stand": ("stand",), "wave": ("wave",)}
    windows = PlanWindows(made, frames, shape, ToldSentences(told, encoder, 4), 0.0, 0)
    windows.normaliser = Normaliser(np.zeros(size, np.float32), np.ones(size, np.float32)).to_torch()
    batch = windows.draw(256, torch.Generator().manual_seed(0)).frames[:, :, frames.layout.slice("height")]
    assert (batch[:, 6:] == 1.0).all()
    assert (batch[:, :2] == 0.0).all()
    seams = (batch[:, :6, 0] == 1.0).sum(1)
    assert set(seams.tolist()) == {0, 1, 2, 3, 4}, "of the plan that runs meanwhile"
    starts = [windows._training[1][1][i] % 200 + 6 for i in range(len(windows._training[1][1]))]
    assert all(100 <= int(start) < 110 for start in starts)
