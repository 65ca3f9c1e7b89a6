"""What hips and ankles do about a base that tilts or turns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.stack.safety.balance import Balance, Feedback
from servoid.stack.skills.skill import load_skills

ROBOT = load_robot()
UPRIGHT = -up_vector(Legs(ROBOT).stand(ROBOT.home)[1])


def answered(balance: Balance, tilt: tuple[float, float], rate: tuple[float, float, float]) -> dict[str, float]:
    """What is added to the joints at home, those that get anything; `tilt` is of gravity, forward and to the left."""
    gravity = UPRIGHT + np.array([*tilt, 0.0])
    added = Feedback(ROBOT)(ROBOT.home, gravity, np.array(rate), balance.gains) - ROBOT.home
    return {name: float(x) for name, x in zip(ROBOT.names, added, strict=True) if abs(x) > 1e-12}


def test_a_base_that_pitches_forward_turns_both_toes_down() -> None:
    found = answered(Balance(ankle_pitch=(0.1, 0.5)), (0.2, 0.0), (0.0, 1.0, 0.0))
    # The left ankle's axis points to the right: there the same way has the other sign.
    assert found == pytest.approx({"l_ank_pitch": -0.2, "r_ank_pitch": 0.2})


def test_rolling_is_for_the_joints_that_roll_and_each_gain_for_its_own() -> None:
    assert answered(Balance(hip_roll=(0.1, 0.0)), (0.0, 0.0), (2.0, 1.0, 0.0)) == pytest.approx(
        {"l_hip_roll": -0.2, "r_hip_roll": -0.2}
    )
    balance = Balance(ankle_roll=(0.0, 0.5), ankle_pitch=(0.0, 9.0))
    assert answered(balance, (0.0, -0.1), (0.0, 0.0, 0.0)) == pytest.approx({"l_ank_roll": 0.05, "r_ank_roll": 0.05})


def test_standing_at_home_it_does_nothing() -> None:
    assert answered(Balance((1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0)), (0.0, 0.0), (0.0, 0.0, 0.0)) == {}


def test_a_leg_that_rolls_at_its_hip_alone_has_no_ankle_to_roll() -> None:
    """Its only joint that rolls was taken for an ankle, and turned by the ankle's gains, the wrong way for a hip."""
    legs = {name: leg[:-1] for name, leg in ROBOT.legs.items()}
    bare = replace(ROBOT, legs=legs)
    rolls = Feedback(bare)._joints[1], Feedback(bare)._joints[3]
    assert [[ROBOT.names[i] for i in one] for one in rolls] == [[], ["l_hip_roll", "r_hip_roll"]]


def test_a_tracker_keeps_its_own_balance(tmp_path: Path) -> None:
    (tmp_path / "w.yaml").write_text("about: w\nclip: wave\nphrases: [w]\nbalance: {hip_roll: [0.1, 0]}\n")
    with pytest.raises(ConfigError, match="balance: is for policy: clip"):
        load_skills(ROBOT, tmp_path)
