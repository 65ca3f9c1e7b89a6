"""The trace of a run: the numbers that were put in come out, and a long run takes no more memory than was taken."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Percept
from servoid.stack.log import trace_buffer
from servoid.stack.log.trace_buffer import TraceBuffer


def add(to: TraceBuffer, tick: int, goal: bool = True) -> None:
    row = np.arange(3.0) + tick
    state = State(
        time_ns=tick,
        orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        gravity=np.array([0.0, 0.0, -1.0]),
        yaw=np.array(0.1 * tick),
        angular_velocity=np.array([0.0, 0.0, 0.5]),
        velocity=10 + row,
        displacement=row,
        position=np.full(2, float(tick)),
        joint_velocity=np.zeros(2),
        contact=np.ones(2),
    )
    to.add(state, Instruction(20 + row), Percept("task", 0.0, goal=np.full(2, tick) if goal else None))


@pytest.mark.parametrize("ticks", [2, 50])
def test_what_was_kept_comes_back(ticks: int) -> None:
    kept = TraceBuffer(2, ticks)
    assert len(kept.trace(0.02, fallen=False).yaw) == 0
    for tick in range(12):  # with room for 2 it has to take more
        add(kept, tick)
    assert len(kept) == 12
    trace = kept.trace(0.02, fallen=True)
    np.testing.assert_array_equal(trace.displacement[:, 1], 1 + np.arange(12))
    np.testing.assert_array_equal(trace.velocity[:, 0], 10 + np.arange(12))
    np.testing.assert_array_equal(trace.command[:, 2], 22 + np.arange(12))
    np.testing.assert_allclose(trace.yaw, 0.1 * np.arange(12))
    np.testing.assert_array_equal(trace.yaw_rate, np.full(12, 0.5))
    assert trace.joints is not None
    np.testing.assert_array_equal(trace.joints, np.arange(12)[:, None] * np.ones(2))
    assert trace.goal is not None
    np.testing.assert_array_equal(trace.goal[:, 0], np.arange(12))
    assert trace.obstacles is None
    assert trace.fallen


def test_what_was_seen_in_some_ticks_only_is_left_out() -> None:
    kept = TraceBuffer(2, 4)
    add(kept, 0)
    add(kept, 1, goal=False)
    assert kept.trace(0.02, fallen=False).goal is None


def test_room_is_made_before_the_run_and_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(TraceBuffer(2, 500)._rows) == 501
    monkeypatch.setattr(trace_buffer, "_LONGEST", 100)
    assert len(TraceBuffer(2, 10**9)._rows) == 101
