"""The planner of the shipped model answers nothing for a second while the robot walks, in the closed loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from shipped_runs import ROBOT

from servoid.hw.contracts.body import Mode
from servoid.hw.contracts.control import Plan, PlanRequest
from servoid.hw.contracts.task import Trace
from servoid.policy.diffusion.settings import load_settings
from servoid.stack.control.diffusion import STAND_SECONDS, DiffusionPolicy, diffusion_policy
from servoid.stack.control.planning.planner import Planner
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import Result, RunSettings, prepare, run
from servoid.tools.common.ground_truth import GroundTruth

pytestmark = pytest.mark.slow

STALL = 50  # ticks: twice as long as a plan lasts
PHASES = (100, 103, 106, 109)  # ticks of the task at which it begins: over half a gait cycle, so over all of a step
SPEED = 0.15  # m/s
AFTER = 70  # ticks that the run goes on for


class Stalled:
    """A planner that is not ready at the ticks of a stall, like one in a process that does not get its turn."""

    def __init__(self, planner: Planner, first: int) -> None:
        self._planner, self._stall = planner, range(first, first + STALL)
        self.policy: DiffusionPolicy

    def reset(self) -> None:
        self._planner.reset()

    def submit(self, request: PlanRequest) -> None:
        self._planner.submit(request)

    def collect(self, tick: int, wait: bool) -> Plan | None:
        assert not wait
        return None if self.policy.plans.tick in self._stall else self._planner.collect(tick, wait)

    def close(self) -> None:
        self._planner.close()


@dataclass(frozen=True)
class Walk:
    first: int  # tick of the task at which the stall began
    result: Result
    truth: Trace
    records: list[TickRecord]
    policy: DiffusionPolicy

    @property
    def task(self) -> list[TickRecord]:
        """Records of the task's ticks."""
        return [record for record in self.records if record.proposal.instruction is not None]


def walk(first: int) -> Walk:
    job = RunSettings("walk", seconds=(first + STALL + AFTER) * ROBOT.dt, seed=1, set={"vx": str(SPEED)})
    assignment, backend = prepare(job)
    body: Any = backend
    policy = diffusion_policy(ROBOT, cost=assignment.task.objective)
    stalled = Stalled(policy.plans.planner, first)
    stalled.policy = policy
    plans = policy.plans
    plans.planner, plans.pace = stalled, replace(plans.pace, wait=False)  # as beside the loop
    ground_truth, records = GroundTruth(body.simulation, ROBOT.dt), list[TickRecord]()

    def watch(record: TickRecord) -> None:
        ground_truth(record)
        records.append(record)

    return Walk(first, run(job, backend=body, on_tick=watch, policy=policy), ground_truth.trace(), records, policy)


@pytest.fixture(scope="module")
def walks() -> list[Walk]:
    return [walk(first) for first in PHASES]


def test_the_last_plan_runs_out_and_the_robot_comes_to_a_stand_until_the_next(walks: list[Walk]) -> None:
    for one in walks:
        plans = {record.proposal.plan.adopted: record.proposal.plan.plan for record in one.task if record.proposal.plan}
        last = max(tick for tick in plans if tick < one.first + 2)
        plan, ends = plans[last], plans[last].tick + len(plans[last].actions)
        until = min(tick for tick in plans if tick > last)
        assert one.first + STALL <= until <= one.first + STALL + load_settings().execution_horizon
        wished = np.array([record.proposal.target for record in one.task[last:until]])
        np.testing.assert_array_equal(wished[: ends - last], plan.actions[last - plan.tick :])
        away = np.abs(wished[ends - last - 1 :] - ROBOT.home).max(1)
        assert away[0] > 0.1  # rad: in mid step
        assert (np.diff(away) <= 0.0).all()
        standing = round(STAND_SECONDS * ROBOT.rate)
        assert 0 < standing < until - ends
        np.testing.assert_allclose(
            wished[ends - last + standing :], ROBOT.home[None].repeat(until - ends - standing, 0)
        )
        assert all(record.command.mode is Mode.ACTIVE for record in one.task[last:until])


def test_events_say_that_a_plan_is_late_and_that_the_last_one_ended_once_each(walks: list[Walk]) -> None:
    for one in walks:
        texts = [event.text for event in one.result.events if event.kind == "plan"]
        assert len(texts) == 2, texts
        assert "was not ready at" in texts[0]
        assert "ended before another one came: the robot comes to a stand" in texts[1]


def moved(one: Walk) -> float:
    """How far it came after the stall [m]."""
    return float(one.truth.displacement[-1, 0] - one.truth.displacement[one.first + STALL, 0])


def test_it_stays_up_and_walks_on_afterwards(walks: list[Walk]) -> None:
    """Held in the pose of a step, the robot fell in half of these when it was to walk on."""
    for one in walks:
        assert one.result.outcome in ("succeeded", "timed_out")
        assert not one.truth.fallen
        assert moved(one) > 0.3 * SPEED * AFTER * ROBOT.dt
        assert one.records[-1].command.mode is Mode.OFF
