from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servoid.policy.diffusion.schedule import (
    DenoisingMatrix,
    Rolling,
    autoregressive,
    cosine_signal,
    ddim_levels,
    full_sequence,
    pyramid,
    rolling,
)

STATES, ACTIONS = np.arange(-4, 16), np.arange(-3, 16)  # frames of 4 past + 16 future states and their actions


def test_signal_falls_from_clean_to_noise() -> None:
    signal = cosine_signal(20)
    assert signal.shape == (21,)
    assert signal[0] == 1.0
    assert (np.diff(signal) < 0).all()
    assert 0 < signal[-1] < 1e-4
    # Half way, about half of the variance is left, which is what sets the cosine schedule apart.
    assert signal[10] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("steps", [1, 3, 4, 5, 7, 20])
def test_ddim_levels_go_from_noise_to_clean_without_repeating(steps: int) -> None:
    levels = ddim_levels(20, steps)
    assert levels[0] == 20
    assert levels[-1] == 0
    assert len(levels) == steps + 1
    assert (np.diff(levels) < 0).all()


@pytest.mark.parametrize("steps", [0, 21])
def test_impossible_numbers_of_steps_are_refused(steps: int) -> None:
    with pytest.raises(ValueError, match="1 to 20"):
        ddim_levels(20, steps)


def test_full_sequence_with_a_lead_finishes_states_before_actions() -> None:
    matrix = full_sequence(20, 4, 3, 2, lead=2)
    assert matrix.calls == 6
    assert matrix.states[:, 0].tolist() == [20, 15, 10, 5, 0, 0, 0]
    assert matrix.actions[:, 1].tolist() == [20, 20, 20, 15, 10, 5, 0]


def test_held_tokens_are_clean_throughout() -> None:
    matrix = full_sequence(20, 4, 3, 2).hold(np.array([True, False, False]), np.array([False, True]))
    assert not matrix.states[:, 0].any()
    assert not matrix.actions[:, 1].any()
    assert matrix.states[0, 1] == 20


def test_a_matrix_whose_levels_rise_is_refused() -> None:
    rising = np.array([[5, 5], [5, 6]])
    with pytest.raises(ValueError, match="never rise"):
        DenoisingMatrix(np.zeros((2, 2), dtype=int), rising)
    with pytest.raises(ValueError, match="as many rows"):
        DenoisingMatrix(np.zeros((2, 2), dtype=int), np.zeros((3, 2), dtype=int))


@st.composite
def matrices(draw: st.DrawFn) -> tuple[DenoisingMatrix, int]:
    """A matrix by any schedule with any parameters, and its highest level."""
    levels = draw(st.integers(1, 50))
    steps, lead = draw(st.integers(1, levels)), draw(st.integers(0, 3))
    horizon, history = draw(st.integers(1, 32)), draw(st.integers(1, 6))
    frames = np.arange(-history, horizon), np.arange(1 - history, horizon)
    level, count = st.integers(1, levels), st.integers(1, 40)
    name = draw(st.sampled_from(["full_sequence", "autoregressive", "pyramid", "rolling"]))
    if name == "full_sequence":
        return full_sequence(levels, steps, len(frames[0]), len(frames[1]), lead), levels
    if name == "autoregressive":
        return autoregressive(levels, steps, *frames, block=draw(count), lead=lead), levels
    if name == "pyramid":
        shape, spread = draw(st.sampled_from(["pyramid", "trapezoid"])), draw(st.integers(0, 20))
        return pyramid(levels, steps, *frames, spread=spread, shape=shape, lead=lead), levels
    start, fresh = (draw(level), draw(level)), draw(st.integers(0, horizon))
    return rolling(levels, steps, *frames, Rolling(*start, ramp=draw(count)), fresh=fresh, lead=lead), levels


@settings(max_examples=150, deadline=None)
@given(matrices())
def test_every_schedule_is_bounded_never_rises_and_ends_clean(drawn: tuple[DenoisingMatrix, int]) -> None:
    matrix, levels = drawn
    for rows in (matrix.states, matrix.actions):
        assert rows.min() == 0
        assert rows.max() <= levels
        assert (np.diff(rows, axis=0) <= 0).all()
        assert not rows[-1].any()
        assert (rows[0] > 0).all()


def test_autoregressive_finishes_a_block_of_frames_before_the_next_begins() -> None:
    matrix = autoregressive(20, 5, STATES, ACTIONS, block=4, lead=1)
    assert matrix.calls == 4 * (5 + 1)
    for row, (states, actions) in enumerate(zip(matrix.states, matrix.actions, strict=True)):
        now = row // 6  # the block that is being denoised
        assert not states[(now > STATES // 4) & (STATES >= 0)].any()
        assert not actions[(now > ACTIONS // 4) & (ACTIONS >= 0)].any()
        assert (states[now < STATES // 4] == 20).all()
        assert (actions[now < ACTIONS // 4] == 20).all()
    # An action goes with the state it leads to: both of frame 4 begin in the second block, states first.
    assert matrix.states[7, STATES == 4] == 16
    assert matrix.actions[7, ACTIONS == 4] == 20


def test_a_pyramid_rises_along_the_window_and_a_trapezoid_to_its_middle() -> None:
    rows = pyramid(20, 5, STATES, ACTIONS, spread=6)
    assert rows.calls == 11
    assert (np.diff(rows.states, axis=1) >= 0).all()
    assert rows.states[5, STATES == 0] == 0  # the first frame is clean
    assert rows.states[5, STATES == 15] == 20  # when the last has hardly begun
    trapezoid = pyramid(20, 5, STATES, ACTIONS, spread=6, shape="trapezoid").states[:, 4:]
    np.testing.assert_array_equal(trapezoid, trapezoid[:, ::-1])
    assert (np.diff(trapezoid[:, :8], axis=1) >= 0).all()
    assert trapezoid[5, 0] == trapezoid[5, -1] == 0
    assert trapezoid[5, 7] == 20
    np.testing.assert_array_equal(pyramid(20, 5, STATES, ACTIONS, spread=0).states, full_sequence(20, 5, 20, 19).states)


def test_rolling_goes_on_from_its_own_levels_and_begins_fresh_frames_as_noise() -> None:
    matrix = rolling(20, 4, STATES, ACTIONS, Rolling(14, 4, ramp=1), fresh=2)
    assert matrix.calls == 4
    assert set(matrix.states[0, STATES < 14]) == {14}
    assert set(matrix.actions[0, ACTIONS < 14]) == {4}
    assert set(matrix.states[0, STATES >= 14]) == set(matrix.actions[0, ACTIONS >= 14]) == {20}
    ramp = rolling(20, 4, STATES, ACTIONS, Rolling(14, 4, ramp=8), fresh=1).actions[0, 3:]
    assert ramp.tolist() == [4] * 8 + [6, 8, 10, 12, 14, 16, 18, 20]


def test_schedules_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one, not 0"):
        autoregressive(20, 5, STATES, ACTIONS, block=0)
    with pytest.raises(ValueError, match="not 'pyramids'"):
        pyramid(20, 5, STATES, ACTIONS, spread=2, shape="pyramids")
    with pytest.raises(ValueError, match="must not be negative"):
        pyramid(20, 5, STATES, ACTIONS, spread=-1)
    with pytest.raises(ValueError, match="rolling states must go on from a level of 1 to 20, not 21"):
        rolling(20, 5, STATES, ACTIONS, Rolling(21, 4))
    with pytest.raises(ValueError, match="ramp"):
        rolling(20, 5, STATES, ACTIONS, Rolling(14, 4, ramp=0))


def test_ignored_tokens_stay_noise_and_cost_no_calls() -> None:
    whole = autoregressive(20, 5, STATES, ACTIONS, block=4)
    half = whole.ignore(STATES >= 8, ACTIONS >= 8, 20)
    assert half.calls == 10
    assert (half.states[:, STATES >= 8] == 20).all()
    assert not half.states[-1, STATES < 8].any()
