"""Motions and the twists that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servoid.hw.robot.description import load_robot
from servoid.policy.text.captions import MOTIONS, NAMES, caption, followed, mirrored, motion_of, twist_of

TOP = load_robot().walking.scale
TWIST = st.tuples(st.floats(-0.15, 0.6), st.floats(-0.13, 0.13), st.floats(-1.2, 1.2))
FLIP = np.array([1.0, -1.0, -1.0])


def name(*twist: float) -> str:
    return NAMES[int(motion_of(np.array(twist), TOP))]


@given(TWIST)
def test_the_mirror_image_of_a_twist_has_the_mirrored_motion(twist: tuple[float, float, float]) -> None:
    index = motion_of(np.array(twist), TOP)
    assert motion_of(FLIP * twist, TOP) == mirrored(index)
    assert mirrored(mirrored(index)) == index


@pytest.mark.parametrize(
    ("twist", "expected"),
    [
        ((0.0, 0.0, 0.0), "stand"),
        ((0.009, -0.009, 0.049), "stand"),
        ((0.02, 0.0, 0.0), "forward slowly"),
        ((0.119, 0.0, 0.0), "forward slowly"),
        ((0.12, 0.0, 0.0), "forward"),
        ((0.25, 0.0, 0.0), "forward fast"),
        ((0.6, 0.05, 0.1), "forward fast"),
        ((-0.15, 0.02, 0.05), "backward"),
        ((-0.06, 0.05, 0.0), "backward"),
        ((-0.04, 0.05, 0.0), "side-step left"),
        ((0.02, -0.08, 0.1), "side-step right"),
        ((0.0, 0.1, 1.2), "turn left"),
        ((0.05, 0.0, -1.0), "turn right"),
        ((0.0, 0.0, 0.05), "turn left"),
        ((0.3, 0.0, 0.4), "arc left"),
        ((0.2, 0.05, -0.3), "arc right"),
        ((0.2, 0.0, -0.15), "forward"),
        ((0.1, -0.08, 0.0), "diagonal right"),
        ((-0.1, 0.0, 0.3), "backward arc left"),
    ],
)
def test_which_motion_a_twist_is(twist: tuple[float, float, float], expected: str) -> None:
    assert name(*twist) == expected


def test_what_is_fast_for_a_small_robot_is_slow_for_a_large_one() -> None:
    asked = np.array([0.13, 0.0, 0.0])
    names = [NAMES[int(motion_of(asked, TOP * size))] for size in (0.5, 1.0, 2.0)]
    assert names == ["forward fast", "forward", "forward slowly"]
    assert followed(NAMES.index("forward fast"), asked, 0.5 * TOP)
    assert not followed(NAMES.index("forward fast"), asked, TOP)


def test_many_twists_at_once_are_named_as_each_alone() -> None:
    """A dataset is labelled in one call."""
    twists = np.random.default_rng(0).uniform([-0.15, -0.13, -1.2], [0.6, 0.13, 1.2], (4, 50, 3))
    together = motion_of(twists, TOP)
    assert together.shape == (4, 50)
    assert np.issubdtype(together.dtype, np.integer)
    assert together[2, 7] == motion_of(twists[2, 7], TOP)
    assert set(np.unique(together)) <= set(range(len(MOTIONS)))


def test_a_motion_is_its_typical_twist_and_no_other_follows_it() -> None:
    """Evaluation would count a robot that does something else, or nothing, as obedient."""
    for asked in range(len(MOTIONS)):
        assert motion_of(twist_of(asked, TOP), TOP) == asked
        obeyed = [NAMES[done] for done in range(len(MOTIONS)) if followed(asked, twist_of(done, TOP), TOP)]
        assert obeyed == [NAMES[asked]]


@pytest.mark.parametrize(
    ("motion", "measured", "expected"),
    [
        ("forward", (0.11, 0.02, 0.1), True),  # a little slow, drifting to the left
        ("forward", (0.03, 0.0, 0.0), False),  # hardly moving
        ("forward slowly", (0.015, 0.0, 0.0), False),
        ("stand", (0.015, -0.01, 0.1), True),  # settling
        ("stand", (0.05, 0.0, 0.0), False),
        ("side-step left", (0.0, 0.05, 0.15), True),
        ("side-step left", (0.1, 0.05, 0.0), False),
        ("turn right", (0.03, 0.01, -0.4), True),
        ("turn right", (0.0, 0.0, 0.4), False),
        ("arc left", (0.2, 0.0, 0.05), False),
        ("backward", (-0.05, 0.01, 0.05), True),
    ],
)
def test_what_counts_as_followed(motion: str, measured: tuple[float, float, float], expected: bool) -> None:
    assert followed(NAMES.index(motion), np.array(measured), TOP) is expected


def test_a_run_that_was_not_measured_is_not_judged() -> None:
    with pytest.raises(ValueError, match="finite"):
        followed(0, np.array([np.nan, 0.0, 0.0]), TOP)


def test_the_caption_is_the_first_phrasing() -> None:
    assert caption(np.array([0.2, 0.0, 0.0]), TOP) == "walk forward"
    assert caption(np.array([0.0, 0.0, -0.5]), TOP) == "turn right on the spot"


def test_phrasings_are_enough_and_held_out_ones_were_never_trained() -> None:
    trained = [text for motion in MOTIONS for text in motion.phrasings]
    held_out = [text for motion in MOTIONS for text in motion.held_out]
    assert len(set(trained)) == len(trained)
    assert len(set(held_out)) == len(held_out)
    assert not set(trained) & set(held_out)
    for motion in MOTIONS:
        assert 6 <= len(motion.phrasings) <= 12, motion.name
        assert 3 <= len(motion.held_out) <= 4, motion.name
