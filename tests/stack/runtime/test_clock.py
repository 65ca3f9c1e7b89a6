"""Schedules that slip, and simulated time in step with the wall."""

from __future__ import annotations

import signal

import pytest
from fake_body import ManualClock

from servoid.stack.runtime.clock import RealTime, Schedule, WallClock
from servoid.stack.runtime.interrupt import Interrupt

MS = 1_000_000


def test_ticks_come_on_time_and_in_order():
    clock = ManualClock()
    schedule = Schedule(clock, 50)
    wakes = [schedule.wait() for _ in range(4)]
    assert [wake.tick for wake in wakes] == [0, 1, 2, 3]
    assert clock.now == 60 * MS
    assert schedule.missed == 0


def test_missed_ticks_are_skipped_and_not_replayed_in_a_burst():
    clock = ManualClock()
    schedule = Schedule(clock, 50)
    schedule.wait()
    clock.now = 95 * MS  # held up in tick 0, until after the deadlines of 1 to 4
    wake = schedule.wait()
    assert (wake.tick, wake.missed, wake.late_ns) == (4, 3, 15 * MS)
    assert schedule.wait().tick == 5
    assert clock.now == 100 * MS  # on the original schedule
    assert schedule.missed == 3


def test_a_slow_machine_changes_nothing_in_simulated_time():
    simulated, wall = ManualClock(), ManualClock()
    schedule = Schedule(RealTime(simulated, wall), 50)
    ticks = []
    for i in range(8):
        ticks.append((schedule.wait().tick, simulated.now))
        wall.now += 70 * MS if i == 3 else 5 * MS
    assert ticks == [(i, 20 * MS * i) for i in range(8)]
    assert schedule.missed == 2  # 70 ms of work: two deadlines passed on the wall, and were counted


def test_after_a_hold_up_the_wall_schedule_starts_anew():
    simulated, wall = ManualClock(), ManualClock()
    clock = RealTime(simulated, wall)
    clock.sleep_until(20 * MS)
    wall.now += 500 * MS
    clock.sleep_until(40 * MS)
    before = wall.now
    clock.sleep_until(60 * MS)
    assert wall.now - before == 20 * MS  # no hurry to make up for it


def test_the_wall_clock_sleeps_to_a_deadline():
    clock = WallClock()
    deadline = clock.now_ns() + 30 * MS
    clock.sleep_until(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until(deadline - 3_600_000 * MS)  # passed already: whoever sleeps then does so for an hour


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_are_counted_and_handlers_restored(number):
    before = signal.getsignal(number)
    with Interrupt() as interrupt:
        signal.raise_signal(number)
        signal.raise_signal(number)
        assert interrupt.count == 2
    assert signal.getsignal(number) is before


def test_the_second_signal_breaks_a_policy_that_hangs():
    with Interrupt() as interrupt:
        interrupt.breakable = True
        signal.raise_signal(signal.SIGINT)  # the first never raises
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
