"""Runs of the policy that ships, judged by the truth, with all that its planners were asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from servoid.hw.contracts.control import Adopted, Plan, PlanRequest
from servoid.hw.contracts.task import Trace
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.runtime import Runtime
from servoid.stack.control.planning.planner import Answer, InlinePlanner
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import Result, RunSettings, prepare, run
from servoid.tools.common.ground_truth import GroundTruth

ROBOT = load_robot()


class Asked(InlinePlanner):
    """Keeps what it is asked, so that the same can be planned again with one thing changed."""

    def __init__(self, answer: Answer) -> None:
        super().__init__(answer)
        self.requests: list[PlanRequest] = []

    def submit(self, request: PlanRequest) -> None:
        self.requests.append(request)
        super().submit(request)

    def again(self, request: PlanRequest, **asked: Any) -> Plan:
        """The plan of a request that asks for something else: of the same noise, so nothing else makes it differ."""
        return self.answer(replace(request, instruction=replace(request.instruction, **asked)))

    def answer(self, request: PlanRequest) -> Plan:
        """The plan of a request, without collecting it."""
        return self._answer(request)

    @property
    def runtime(self) -> Runtime:
        runtime: Runtime = self._answer.args[0]  # type: ignore[attr-defined]
        return runtime


@dataclass(frozen=True)
class Driven:
    result: Result
    truth: Trace
    records: Sequence[TickRecord]  # of all ticks, from before the task to torque off
    planners: Sequence[Asked] = field(default_factory=list)  # one a robot

    @property
    def planner(self) -> Asked:
        return self.planners[0]

    @property
    def plans(self) -> list[Adopted]:
        """What was adopted while the task lasted, in order."""
        seen = [record.proposal for record in self.records if record.proposal.instruction is not None]
        return [proposal.plan for proposal in seen if proposal.plan is not None]

    def told(self) -> set[str]:
        """Kinds of the events until the task was over, but for those of every run."""
        last = max(record.tick for record in self.records if record.proposal.instruction is not None)
        return {event.kind for event in self.result.events if event.tick <= last} - {"phase", "task"}


def drive(
    task: str, chosen: Mapping[str, str] | None = None, seconds: float = 2.0, policy: str = "diffusion", seed: int = 1
) -> Driven:
    """A run by the way that `servoid run` takes: `chosen` are the task's settings."""
    settings = RunSettings(task, policy=policy, seconds=seconds, seed=seed, set=chosen or {})
    _, backend = prepare(settings)
    body: Any = backend
    ground_truth, records, planners = GroundTruth(body.simulation, ROBOT.dt), list[TickRecord](), list[Asked]()

    def watch(record: TickRecord) -> None:
        ground_truth(record)
        records.append(record)

    def listening(answer: Answer) -> Asked:
        planners.append(Asked(answer))
        return planners[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servoid.stack.control.diffusion.InlinePlanner", listening)
        result = run(settings, backend=body, on_tick=watch)
    for planner in planners:  # what comes after the task is no concern of it: to stand
        planner.requests = [request for request in planner.requests if request.tick < result.ticks - 1]
    return Driven(result, ground_truth.trace(), records, planners)


def walked(driven: Driven, ticks: int = 101) -> Driven:
    """Asserts that the robot stayed up for so many ticks of the task, and that every plan came in time and was run."""
    assert not driven.truth.fallen
    assert not driven.result.trace.fallen
    assert driven.told() == set()
    assert len(driven.truth.yaw) == ticks
    settings = driven.planner.runtime.settings
    for planner in driven.planners:
        assert len(planner.requests) >= (ticks - 6) // settings.execution_horizon
    assert len(driven.plans) in (len(driven.planner.requests) - 1, len(driven.planner.requests))
    assert {plan.adopted - plan.requested for plan in driven.plans} == {settings.delay}
    # What is planned again is what was run: else no comparison of plans would be of the run's own.
    for adopted in driven.plans[-2:]:
        (request,) = (one for one in driven.planner.requests if one.tick == adopted.requested)
        np.testing.assert_array_equal(driven.planner.answer(request).actions, adopted.plan.actions)
    return driven
