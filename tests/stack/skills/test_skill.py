"""Skills as files: what they must agree with, and how one leads to another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_body import StillEstimator, observation

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import header
from servoid.policy.mlp import Mlp
from servoid.policy.motion.library import Library
from servoid.policy.tracker.observation import RESIDUAL, TrackerObservation
from servoid.stack.control.clip import SETTLE_SECONDS
from servoid.stack.skills.performers import perform
from servoid.stack.skills.skill import load_skills, steps, way

ROBOT = load_robot()
SKILLS = load_skills(ROBOT)


def test_every_skill_lasts_as_long_as_its_clip() -> None:
    library = Library(ROBOT)
    assert {"wave", "kick-left", "kick-right", "sit-down", "rise"} <= SKILLS.keys()
    for name, skill in SKILLS.items():
        assert skill.name == name
        assert skill.seconds == pytest.approx((library[skill.clip].ticks - 1) * ROBOT.dt)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("about: w\nclip: wave\nphrases: [w]\nentry: sitting\n", r"w\.yaml:4: entry: 'sitting', but .* has 'upright'"),
        ("about: w\nclip: wave\nphrases: [w]\nend: floating\n", r"w\.yaml:4: end: 'floating' is none of upright"),
        ("about: w\nclip: wav\nphrases: [w]\n", "unknown clip 'wav' in .*did you mean 'wave'"),
        ("about: w\nclip: wave\nphrases: []\n", r"w\.yaml:3: phrases: at least one is needed"),
        ("about: w\nclip: wave\nphrases: [w]\npolicy: magic\n", r"w\.yaml:4: policy"),
        ("about: w\nclip: wave\nphrases: [w]\nafter: {moved: 0}\n", r"w\.yaml:4: after.*moved: must be positive"),
        (
            "about: s\nclip: sit-down\nphrases: [s]\nend: sitting\ninterrupted_by: anything\n",
            r"w\.yaml:5: interrupted_by: a skill that does not stay on its feet",
        ),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "w.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_skills(ROBOT, tmp_path)


def test_the_way_to_a_skill_leads_through_the_poses_that_it_begins_in() -> None:
    sit, rise, wave = SKILLS["sit-down"], SKILLS["rise"], SKILLS["wave"]
    assert way("sitting", "sitting", SKILLS) == ()
    assert steps("sitting", wave, SKILLS) == (rise, wave)
    assert steps("upright", sit, SKILLS) == (sit,)
    assert steps("upright", rise, SKILLS) == (), "it stands already"
    assert steps("sitting", sit, SKILLS) == ()
    with pytest.raises(ConfigError, match="no skill leads from 'lying on the front' to 'upright'"):
        way("lying on the front", "upright", SKILLS)


def network(path: Path, config: dict[str, object], *, clips: bool) -> Path:
    """A tracker that was never trained: its residual is the same for all it sees."""
    inputs, joints = TrackerObservation(ROBOT, clips=clips).size, len(ROBOT.joints)
    layer = (np.zeros((inputs, joints), np.float32), np.full(joints, 0.1, np.float32))
    head = header("tracker", ROBOT, config=config, data="none", licence="Apache-2.0", results={})
    Mlp([layer], np.zeros(inputs), np.ones(inputs)).save(path, head)
    return path


def test_a_tracker_of_clips_performs_where_the_file_says_so(tmp_path: Path) -> None:
    path = network(tmp_path / "clips.safetensors", {"clips": ["wave"]}, clips=True)
    (tmp_path / "wave.yaml").write_text(f"about: w\nclip: wave\nphrases: [w]\npolicy: tracker\ntracker: {path}\n")
    performer = perform(load_skills(ROBOT, tmp_path)["wave"], ROBOT)
    performer.reset(None, np.zeros((), int))
    state = StillEstimator(ROBOT).update(observation(ROBOT, 0, ROBOT.home), ROBOT.home)
    goals = [performer.act(state, ROBOT.home, Instruction(np.zeros(3))) for _ in range(Library(ROBOT)["wave"].ticks)]
    assert not performer.ended, "it comes to a stand first"
    for _ in range(round(SETTLE_SECONDS * ROBOT.rate)):
        performer.act(state, ROBOT.home, Instruction(np.zeros(3)))
    assert performer.ended
    np.testing.assert_allclose(goals[-1] - Library(ROBOT)["wave"].joints[-1], 0.1 * RESIDUAL, atol=1e-3)


def test_a_tracker_of_the_gait_alone_is_refused(tmp_path: Path) -> None:
    path = network(tmp_path / "gait.safetensors", {}, clips=False)
    (tmp_path / "wave.yaml").write_text(f"about: w\nclip: wave\nphrases: [w]\npolicy: tracker\ntracker: {path}\n")
    with pytest.raises(ConfigError, match=r"skill 'wave': policy: tracker: .*a tracker of the gait alone"):
        perform(load_skills(ROBOT, tmp_path)["wave"], ROBOT)
