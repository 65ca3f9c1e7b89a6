"""The diffusion model that ships and knows skills does what it is told, in mid motion."""

from __future__ import annotations

import pytest

from servoid.hw.config import ConfigError
from servoid.policy.checkpoint import read_header, resolve
from servoid.policy.diffusion.settings import load_settings
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.evaluate.judge import judge

pytestmark = pytest.mark.slow


def test_a_skill_is_performed_in_words_after_another_that_is_left_half_done() -> None:
    judged = judge(RunSettings("skill", policy="skills", seed=2, set={"text": "wave hello; bow to us", "every": "3"}))
    assert judged.row["metrics"]["joint_rms_rad"] < 0.12  # of the bow
    assert not judged.row["fell"]


def test_it_walks_when_it_is_told_to() -> None:
    result = run(RunSettings("text", policy="skills", seed=2, set={"sentence": "walk forward", "seconds": "6"}))
    assert result.success, result.outcome


def test_it_makes_smaller_plans_than_the_one_that_only_walks_and_says_which_skills_it_knows() -> None:
    ours, other = (read_header(resolve(load_settings(name).checkpoint)) for name in ("skills", "diffusion"))
    assert len(ours["config"]["ticks"]) < other["config"]["horizon"]
    assert ours["config"]["width"] == other["config"]["width"]
    assert "wave" in ours["skills"]
    with pytest.raises(ConfigError, match="does not know the skill 'sit-on-seat'"):
        run(RunSettings("skill", policy="skills", set={"name": "sit-on-seat"}, seconds=3.0))
