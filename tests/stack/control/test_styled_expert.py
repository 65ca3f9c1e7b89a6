"""Walking in a style: legs by the style's gait, and an upper body of which the expert sees nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError, available
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.policy.references.gait import gait_of
from servoid.policy.references.style import WalkingStyle, load_style
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.styled import StyledExpert

ROBOT = load_robot()
LEGS = ROBOT.leg_index.ravel()


def joint(name: str) -> int:
    return ROBOT.names.index(name)


def test_the_expert_sees_nothing_of_what_the_arms_do() -> None:
    """Wherever they are, it decides the same, and they do what the style says."""
    style = WalkingStyle(joints={"l_sho_roll": 0.0}, swing={"head_pan": 0.4})
    fleet = Fleet(ROBOT, 2, None, seed=0)
    styled, other = (StyledExpert(ROBOT, style, shape=(2,)) for _ in range(2))
    fleet.reset(np.ones(2, bool))
    for policy in (styled, other):
        policy.reset(None, fleet.seeds)
    told, heads = Instruction(np.tile([0.2, 0.0, 0.0], (2, 1))), []
    shoulders = [joint("l_sho_roll"), joint("r_sho_roll")]
    for _ in range(80):
        state, position, applied = fleet.observe(), fleet.state.position.copy(), fleet.applied.copy()
        position[:, shoulders], applied[:, shoulders] = 0.9, -0.9
        target = styled.act(state, fleet.applied, told)
        assert np.array_equal(other.act(replace(state, position=position), applied, told), target)
        fleet.step(target)
        heads.append(target[0, joint("head_pan")])
    assert np.allclose(target[:, shoulders], 0.0)
    assert max(heads) > 0.3 > -0.3 > min(heads)
    assert not fleet.truth.fallen.any()


def test_a_style_is_of_both_sides_but_where_it_is_one_sided() -> None:
    both = WalkingStyle(joints={"l_el": -1.2}, swing={"l_sho_pitch": 0.7})
    where, at, swing = both.held(ROBOT)
    assert at[joint("l_el")] == -1.2 == -at[joint("r_el")]  # a mirror turns the sign of this robot's elbows
    assert swing[joint("l_sho_pitch")] == swing[joint("r_sho_pitch")] == 0.7  # which so swing one after the other
    assert not where[LEGS].any()
    where, at, _ = WalkingStyle(joints={"l_el": -1.2}, one_sided=True).held(ROBOT)
    assert np.flatnonzero(where).tolist() == [joint("l_el")]
    assert at[joint("r_el")] == ROBOT.home[joint("r_el")]


def test_every_shipped_style_is_another_one() -> None:
    gait, seen = gait_of(ROBOT), set()
    for name in available("styles"):
        style = load_style(name, ROBOT)
        _, at, swing = style.held(ROBOT)
        seen.add((style.changed(gait), at.tobytes(), swing.tobytes(), style.lower, style.dip))
    assert len(seen) == len(available("styles")) == 12


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("joints: {l_elbow: 0.1}", r"mine\.yaml:1: joints\.l_elbow: op3 has no such joint"),
        ("lower: 0.01\nswing: {l_knee: 0.1}", r"mine\.yaml:2: swing\.l_knee: the legs walk by the gait"),
        ("joints: {l_el: 9}", r"joints\.l_el: must be in its range of -2\.6 to 1\.57"),
        ("gait: {lifts: 2}", r"gait\.lifts: no such setting of the gait; did you mean 'lift'"),
    ],
)
def test_a_style_that_cannot_be_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_style(str(tmp_path / "mine.yaml"), ROBOT)
