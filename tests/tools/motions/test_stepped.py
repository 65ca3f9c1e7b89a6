"""Clips of steps, which physics plays, and the search for a harder kick."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError, load_yaml
from servoid.hw.robot.description import load_robot
from servoid.stack.skills.skill import load_skills
from servoid.tools.cli import main
from servoid.tools.motions.author import author
from servoid.tools.motions.keyframes import Authored, JointStep, load_authored
from servoid.tools.motions.stepped import stepped_goals, through
from servoid.tools.robots.kicks import Kicks
from servoid.tools.robots.tune_kick import Space, cost

ROBOT = load_robot()
KNEE = ROBOT.names.index("r_knee")


def recipe(tmp_path: Path, steps: str) -> Authored:
    path = tmp_path / "made.yaml"
    about = "licence: Apache-2.0\nclips:\n  - name: made\n    captions: [made]\n    mirrored: other\n"
    path.write_text(f"{about}    steps: [{steps}]\n")
    return load_yaml(path, Authored)


def test_a_curve_passes_where_it_goes_on_and_rests_where_it_turns() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0])
    poses = np.array([[0.0], [1.0], [2.0], [0.0]])
    at = np.linspace(0.0, 3.0, 301)
    curve = through(times, poses, at)[:, 0]
    assert through(times, poses, times)[:, 0] == pytest.approx(poses[:, 0])
    assert [curve.min(), curve.max()] == pytest.approx([0.0, 2.0]), "no further than its points"
    rate = np.diff(curve) * 100
    assert rate[100] == pytest.approx(1.0, abs=0.05), "it passes through"
    assert np.abs(rate[[0, 199]]).max() < 0.1, "it rests where it turns back, and at its ends"


def test_steps_say_what_changes_and_home_brings_everything_back() -> None:
    goals = stepped_goals(
        (JointStep(0.2, {"r_knee": -1.2}), JointStep(0.2, {"l_el": -0.8}, hold=0.1), JointStep(0.2, home=True)), ROBOT
    )
    assert len(goals) == 35
    assert goals[[9, 24], KNEE] == pytest.approx([-1.2, -1.2])
    assert goals[-1] == pytest.approx(ROBOT.home)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ("{seconds: 0.2, joints: {r_kne: -1}}", "clip 'made', step 1: unknown joint 'r_kne': did you mean 'r_knee'"),
        ("{seconds: 0.2}, {seconds: 0.1, joints: {r_knee: 1}}", "step 2: r_knee goes 0.71 rad beyond its range"),
        ("{seconds: 0.1, joints: {l_hip_pitch: 0.6, r_hip_pitch: -0.6}}", r"the robot falls \d\.\d s into it"),
        ("{seconds: 0}", "seconds: must be above 0"),
        ("", "frames, or steps: at least one is needed"),
    ],
)
def test_steps_that_cannot_be_are_refused(tmp_path: Path, steps: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        list(author(recipe(tmp_path, steps), ROBOT, "a test"))


def test_the_shipped_kick_is_made_for_both_feet_within_the_speeds_that_the_guard_allows() -> None:
    clips = list(author(load_authored("kick"), ROBOT, "a test"))
    assert [clip.name for clip in clips] == ["kick-right", "kick-left"]
    for clip in clips:
        assert clip.joints[-1] == pytest.approx(ROBOT.home, abs=1e-4)
        assert np.abs(np.diff(clip.joints, axis=0)).max() <= ROBOT.limits.joint_speed * ROBOT.dt + 1e-9


def test_a_harder_kick_that_falls_costs_more_than_a_soft_one_that_stands() -> None:
    still = np.zeros((3, 1))
    kicks = Kicks(np.array([[1.5], [2.0], [2.5]]), still, np.array([[1.0], [1.0], [0.6]]), still, still, still)
    assert np.argsort(cost(kicks)).tolist() == [1, 0, 2]
    aside = Kicks(np.full((2, 1), 2.0), np.array([[0.0], [0.6]]), np.ones((2, 1)), *[np.zeros((2, 1))] * 3)
    assert cost(aside)[0] < cost(aside)[1] - 0.5


def test_the_search_begins_with_the_recipe_and_stays_within_the_joints_ranges() -> None:
    clip = load_authored("kick").clips[0]
    space = Space(clip, ROBOT)
    assert space.at(np.zeros(space.size)) == clip
    far = space.at(np.full(space.size, 30.0))
    stepped_goals(far.steps, ROBOT)
    assert far.balance.gains.min() > 0.5


def test_the_kicks_are_performed_with_the_balance_that_they_were_made_with() -> None:
    skills, clip = load_skills(ROBOT), load_authored("kick").clips[0]
    assert skills["kick-right"].balance == skills["kick-left"].balance == clip.balance


@pytest.mark.slow
def test_a_search_writes_a_recipe_that_is_read_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "found.yaml"
    command = ["tune", "kick", "--generations", "1", "--candidates", "4", "--worlds", "1", "--sigma", "0.01"]
    assert main([*command, "--randomise", "0", "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ball_speed_mps"] > 1.5
    assert found["stands_share"] == 1.0
    assert [clip.name for clip in author(load_authored(str(out)), ROBOT, "a test")] == ["kick-right", "kick-left"]
