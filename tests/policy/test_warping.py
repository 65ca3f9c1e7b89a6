"""The error of an imitation by time warping, on curves whose error is known."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.policy.motion.warping import seen_upright, warped_error


def curve(ticks: int, of: float = 1.0) -> np.ndarray:
    """A point that goes along x from 0 to 1 and back to 0 over `ticks`, and one that stays."""
    x = np.sin(np.pi * np.linspace(0.0, 1.0, ticks)) * of
    moving = np.stack([x, 0.0 * x, 0.0 * x], -1)
    return np.stack([moving, np.zeros_like(moving)], 1)


def test_when_and_how_fast_it_is_done_does_not_count() -> None:
    waits = np.concatenate([curve(41)[:1]] * 30 + [curve(41)] + [curve(41)[-1:]] * 20)
    assert warped_error(waits, curve(41)) == pytest.approx(0.0, abs=1e-12)
    slow = curve(81)  # half as fast: every other of its frames is one of the clip's
    assert warped_error(slow, curve(41)) < 0.01
    assert warped_error(curve(41), curve(41)) == 0.0


def test_an_offset_is_the_error_and_a_part_left_out_costs_what_it_is_away() -> None:
    assert warped_error(curve(41) + np.array([0.0, 0.03, 0.0]), curve(41)) == pytest.approx(0.03)
    still = np.zeros((100, 2, 3))
    expected = np.sin(np.pi * np.linspace(0.0, 1.0, 41)).mean() / 2.0  # one of two points stands where the other goes
    assert warped_error(still, curve(41)) == pytest.approx(expected)
    half = curve(41, of=0.5)
    assert 0.0 < warped_error(half, curve(41)) < warped_error(still, curve(41))


def test_a_loop_may_begin_anywhere_and_all_of_its_motion_counts() -> None:
    cycle = curve(24)[:-1]
    walked = np.tile(cycle, (5, 1, 1))[9:95]
    assert warped_error(walked, cycle, loop=True) == pytest.approx(0.0, abs=1e-12)
    stops = np.concatenate([walked, walked[-1:] + np.array([[[0.0, 0.0, 0.2]]])])
    assert warped_error(stops, cycle, loop=True) > 0.001


def test_nothing_is_infinitely_far() -> None:
    assert warped_error(np.zeros((0, 2, 3)), curve(5)) == float("inf")


def test_tilt_counts_and_heading_does_not() -> None:
    points = np.array([[[0.1, 0.0, 0.0]]])
    turned = seen_upright(points, np.array([[np.cos(0.5), 0.0, 0.0, np.sin(0.5)]]))
    assert turned == pytest.approx(points)
    pitched = seen_upright(points, np.array([[np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4), 0.0]]))
    assert pitched == pytest.approx(np.array([[[0.0, 0.0, -0.1]]]), abs=1e-9)
