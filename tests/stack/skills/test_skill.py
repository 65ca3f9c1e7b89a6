"""Skills as files: what they must agree with, and how one leads to another."""

from __future__ import annotations

from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
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


def test_a_tracker_is_one_word_in_the_file_and_refused_while_there_is_none(tmp_path: Path) -> None:
    (tmp_path / "wave.yaml").write_text("about: w\nclip: wave\nphrases: [w]\npolicy: tracker\n")
    with pytest.raises(ConfigError, match="skill 'wave': policy: tracker needs a tracker of clips"):
        perform(load_skills(ROBOT, tmp_path)["wave"], ROBOT)
