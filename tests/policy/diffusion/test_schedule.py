from __future__ import annotations

import numpy as np
import pytest

from policy.diffusion.schedule import DenoisingMatrix, cosine_signal, ddim_levels, full_sequence


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
