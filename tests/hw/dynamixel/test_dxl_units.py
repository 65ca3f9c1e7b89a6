"""Ticks and radians: there and back, through the seam, and with the sign that the robot's file gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.robot.description import Robot, load_robot

ROBOT = load_robot("op3")
TICK = 2 * np.pi / 4096


def units(robot: Robot = ROBOT, model: str = "xm430-w350") -> Units:
    return Units(robot, [table(model)] * len(robot.joints))


def with_joint(index: int, **changes: object) -> Robot:
    joints = list(ROBOT.joints)
    joints[index] = replace(joints[index], **changes)  # type: ignore[arg-type]
    return replace(ROBOT, joints=tuple(joints))


@pytest.mark.slow
@given(st.integers(0, 19), st.floats(0, 1), st.sampled_from([1, -1]), st.floats(-0.3, 0.3))
def test_a_goal_that_is_reached_reads_back(index: int, part: float, direction: int, zero: float) -> None:
    robot = with_joint(index, direction=direction, zero=zero)
    here = units(robot)
    q = robot.lower + part * (robot.upper - robot.lower)
    np.testing.assert_allclose(here.position(here.goal(q)), q, atol=TICK * 0.51)


def test_direction_and_zero() -> None:
    here = units(with_joint(0, direction=-1, zero=0.1))
    ticks = np.full(20, 2048 + 1024)
    assert here.position(ticks)[0] == pytest.approx(-np.pi / 2 + 0.1)
    assert here.velocity(np.full(20, 100))[0] == pytest.approx(-100 * 0.023980824)
    assert here.effort(np.full(20, -100))[0] == pytest.approx(100 * 0.00269 * 1.783)
    assert here.goal(np.full(20, 0.1))[0] == 2048


def test_turns_that_a_limp_servo_counted_do_not_matter() -> None:
    """It says 5000 or -3000 after being turned by hand; the joint is where it is."""
    here = units()
    ticks = np.full(20, 2100)
    for turns in (-2, -1, 1, 3):
        np.testing.assert_allclose(here.position(ticks + 4096 * turns), here.position(ticks))


def test_the_seam_does_not_tear_an_angle() -> None:
    """A horn mounted half a turn off puts the seam in the middle of the range: reading is right, and it is reported."""
    robot = with_joint(3, zero=np.pi)
    here = units(robot)
    ticks = np.full(20, 2048)
    ticks[3] = 4095
    before = here.position(ticks)[3]
    ticks[3] = 0
    assert here.position(ticks)[3] - before == pytest.approx(TICK)
    assert here.across_the_seam() == [robot.names[3]]
    assert units().across_the_seam() == []


def test_what_is_not_measured_is_not_invented() -> None:
    raw = np.full(20, 10.0)
    assert np.isnan(units(model="xl430-w250").effort(raw)).all()
    assert np.isnan(units(model="xc330-t288").effort(raw)).all(), "the supply's current is not the motor's"
    assert np.isfinite(units().effort(raw)).all()
    raw[4] = np.nan
    assert np.isnan(units().position(raw)[4])


def test_a_goal_that_is_not_finite_is_named() -> None:
    q = ROBOT.home.copy()
    q[11] = np.nan
    with pytest.raises(ValueError, match="l_knee"):
        units().goal(q)


def test_gains_are_the_firmwares() -> None:
    np.testing.assert_array_equal(units().gain(np.full(20, 0.5)), 400)
    np.testing.assert_array_equal(units().gain(np.full(20, 100.0)), 16383)


def test_behind_a_gear_a_joint_goes_further_than_a_turn_of_its_servo() -> None:
    """Which turn the servo is in is known by the home pose, however often it was turned before."""
    robot = with_joint(0, gear=4.0, range=(-1.5, 1.5), home=0.2, direction=-1)
    here = units(robot)
    assert here.extended.tolist() == [True] + [False] * 19
    assert here.across_the_seam() == []
    for turned in (-3, 0, 2):
        start = units(robot).goal(np.where(here.extended, 0.35, ROBOT.home)) + here.extended * 4096 * turned
        here.anchor(start.tolist())
        assert here.position(start)[0] == pytest.approx(0.35, abs=TICK)
        for q in (-1.5, 1.5):
            there = here.goal(np.where(here.extended, q, ROBOT.home))
            assert there[0] - start[0] == pytest.approx(-(q - 0.35) * 4 / TICK, abs=1)
            assert here.position(there)[0] == pytest.approx(q, abs=TICK)
        assert here.within_turn(start)[0] == start[0]
