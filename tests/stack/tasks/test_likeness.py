"""Which motion a robot went through is told from its joints, whenever it began."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.stack.skills.skill import clip_of, load_skills
from servoid.stack.tasks.terms.likeness import STILL, SeenMotion, misfit, nearest, performed

ROBOT = load_robot()
NAMES = ("nod", "wave", "crouch", "squat", "kick-low-left", "kick-low-right", "sit-down")
WINDOW = 200  # ticks


@pytest.fixture(scope="module")
def motions() -> Mapping[str, SeenMotion]:
    skills = load_skills(ROBOT)
    clips = {name: clip_of(skills[name], ROBOT).joints for name in NAMES}
    return {
        name: SeenMotion(joints, joints[-1] if name == "sit-down" else ROBOT.home) for name, joints in clips.items()
    }


def seen(motion: SeenMotion, late: int, noise: float = 0.03) -> Array:
    """A window in which a motion begins `late` ticks after its beginning, not quite as it should be."""
    whole = np.concatenate([np.tile(ROBOT.home, (late, 1)), motion.joints, np.tile(motion.after, (WINDOW, 1))])[:WINDOW]
    return whole + noise * np.random.default_rng(0).standard_normal(whole.shape)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("late", [0, 41, 90])
def test_a_motion_is_told_from_all_others_whenever_it_begins(
    name: str, late: int, motions: Mapping[str, SeenMotion]
) -> None:
    assert nearest(seen(motions[name], late), motions, ROBOT.home, ROBOT.dt)[0] == name


def test_standing_is_no_motion_not_even_a_small_one(motions: Mapping[str, SeenMotion]) -> None:
    still = np.tile(ROBOT.home, (WINDOW, 1))
    assert nearest(still, motions, ROBOT.home, ROBOT.dt)[0] == STILL
    assert not performed("nod", still, motions, ROBOT.home, ROBOT.dt)


def test_a_motion_that_is_done_badly_is_not_done(motions: Mapping[str, SeenMotion]) -> None:
    # It is nearest to none other; but half of each movement is missing.
    half = ROBOT.home + 0.5 * (seen(motions["wave"], 0) - ROBOT.home)
    assert performed("wave", seen(motions["wave"], 0), motions, ROBOT.home, ROBOT.dt)
    assert not performed("wave", half, motions, ROBOT.home, ROBOT.dt)


def test_a_window_that_shows_too_little_of_a_motion_says_nothing(motions: Mapping[str, SeenMotion]) -> None:
    assert misfit(np.tile(ROBOT.home, (30, 1)), motions["wave"], ROBOT.dt) == (np.inf, np.inf)
