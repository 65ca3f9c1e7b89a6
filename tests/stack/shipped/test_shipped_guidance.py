"""Guidance by a cost alone, through the checkpoint that ships: it moves what the robot does, and the right way.

Sentence and noise are the same in whatever is compared. By the shipped settings guidance is a cost of velocities, taken
on the predicted states; the papers' costs, of places and directions, are taken through the network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped_runs import ROBOT, Asked, Driven, drive, walked

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, PlanRequest, State
from servoid.hw.contracts.task import Trace
from servoid.policy.diffusion.runtime import Runtime, load_runtime
from servoid.policy.diffusion.settings import DiffusionSettings, load_settings
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.diffusion import DiffusionPolicy, diffusion_policy
from servoid.stack.runtime.run import RunSettings, prepare, run
from servoid.stack.tasks import load_task
from servoid.tools.common.ground_truth import GroundTruth
from servoid.tools.evaluate.policies import Policies
from servoid.tools.evaluate.spec import load_evaluation

pytestmark = pytest.mark.slow

SHIPPED = load_settings()
UNGUIDED = replace(SHIPPED, guidance=replace(SHIPPED.guidance, weight=0.0))
AHEAD = "walk forward"  # what all are told, whatever the cost asks for
SEEDS = (0, 1, 2)


@pytest.fixture(scope="module")
def walking() -> Sequence[PlanRequest]:
    """Requests of a robot that walks ahead, over two gait cycles."""
    requests = drive("text", {"sentence": AHEAD}).planner.requests
    return requests[-24::5]


def planner(settings: DiffusionSettings) -> Runtime:
    return load_runtime(ROBOT, settings, load_task("walk", {}, ROBOT.dt, ROBOT).objective)


def actions(runtime: Runtime, requests: Sequence[PlanRequest], velocity: Sequence[float]) -> Array:
    """Planned actions `(requests, seeds, ticks, joints)` rad, without those that were committed."""
    asked = Instruction(np.array(velocity), text=AHEAD)
    plans = [
        [runtime.plan(replace(one, instruction=asked, seeds=np.array(seed))) for seed in SEEDS] for one in requests
    ]
    return np.array([[plan.actions[SHIPPED.delay :] for plan in row] for row in plans])


def size(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


@pytest.mark.parametrize(("one", "other"), [((0.15, 0.0, 0.6), (0.15, 0.0, -0.6)), ((0.3, 0.0, 0.0), (0.05, 0.0, 0.0))])
def test_what_the_cost_asks_for_moves_the_actions_further_than_noise_does(
    walking: Sequence[PlanRequest], one: Sequence[float], other: Sequence[float]
) -> None:
    guided, unguided = planner(SHIPPED), planner(UNGUIDED)
    alone = actions(unguided, walking, one)
    np.testing.assert_array_equal(alone, actions(unguided, walking, other))
    apart = actions(guided, walking, one) - actions(guided, walking, other)
    noise = size(alone - alone.mean(1, keepdims=True))
    assert noise > 0.001  # rad
    for request in apart:
        assert size(request) > noise
        # And the same way from whatever noise: what differs between seeds would be noise again.
        assert size(request.mean(0)) > 0.8 * size(request)


class Told(BasePolicy):
    """The policy that ships, which is told to walk forward at every tick, whatever velocity the task asks for."""

    def __init__(self, policy: DiffusionPolicy) -> None:
        self._policy = policy

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._policy.reset(where, seeds)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        return self._policy.act(state, applied, replace(instruction, text=AHEAD))


def walk(settings: DiffusionSettings, chosen: Mapping[str, str], seconds: float = 2.5) -> Trace:
    """A run by the truth."""
    job = RunSettings("walk", seconds=seconds, seed=1, set=chosen)
    assignment, backend = prepare(job)
    body: Any = backend
    ground_truth = GroundTruth(body.simulation, ROBOT.dt)
    run(
        job,
        backend=body,
        on_tick=ground_truth,
        policy=Told(diffusion_policy(ROBOT, settings, assignment.task.objective)),
    )
    trace = ground_truth.trace()
    assert not trace.fallen
    assert len(trace.yaw) == 1 + round(seconds / ROBOT.dt)
    return trace


def test_a_robot_that_is_told_the_same_goes_where_the_cost_asks() -> None:
    left, right, fast, slow = (
        walk(SHIPPED, chosen)
        for chosen in (
            {"vx": "0.15", "yaw_rate": "0.8"},
            {"vx": "0.15", "yaw_rate": "-0.8"},
            {"vx": "0.3"},
            {"vx": "0.05"},
        )
    )
    assert left.yaw[-1] - right.yaw[-1] > 0.05  # not far: the sentence says ahead, and is heeded more
    assert fast.displacement[-1, 0] - slow.displacement[-1, 0] > 0.08
    alone = [walk(UNGUIDED, chosen, 1.0) for chosen in ({"vx": "0.3"}, {"vx": "0.15", "yaw_rate": "-0.8"})]
    np.testing.assert_array_equal(alone[0].displacement, alone[1].displacement)


def by_its_row(tmp_path: Path, name: str, chosen: Mapping[str, str], ticks: int = 101) -> Driven:
    """A run of a row of the papers' tables, guided as the papers guide."""
    (row,) = (row.experiment for row in load_evaluation("papers").rows if row.name == name)
    policy = Policies("diffusion", tmp_path).name(row)
    driven = walked(drive(row.task, {**row.set, **chosen}, policy=policy), ticks)
    runtime = driven.planner.runtime
    assert runtime.settings.guidance.gradient == "network"
    assert runtime.settings.text_weight == 0.0
    return driven


@pytest.mark.parametrize(
    ("name", "chosen"),
    [("uniphys/obstacle-alone", {"bearing": "0.8"}), ("cloc/forest-alone", {"places": "0.3,0.03,0.05", "x": "1"})],
)
def test_plans_bend_away_from_what_is_in_front(tmp_path: Path, name: str, chosen: Mapping[str, str]) -> None:
    """Centimetres, not what a rounding would be."""
    driven = by_its_row(tmp_path, name, chosen)
    assert driven.truth.touched is False
    for request in driven.planner.requests[2::8]:
        with_it, without = driven.planner.again(request), driven.planner.again(request, obstacles=None)
        assert request.instruction.obstacles is not None
        place = request.instruction.obstacles[0, :2]
        apart = [float(np.linalg.norm(plan.path - place, axis=1).mean()) for plan in (with_it, without)]
        assert apart[0] - apart[1] > 0.01
        assert size(with_it.actions - without.actions) > 0.005  # rad


def aside(planner: Asked, request: PlanRequest, name: str, one: Sequence[float], other: Sequence[float]) -> float:
    """How far to the left of the plan of the `other` instruction that of the `one` ends [m]."""
    ends = [float(planner.again(request, **{name: np.array(asked)}).path[-1, 1]) for asked in (one, other)]
    return ends[0] - ends[1]


def test_a_goal_is_turned_to_by_its_distance_and_bearing_alone(tmp_path: Path) -> None:
    ends = []
    for y in ("0.4", "-0.4"):
        driven = by_its_row(tmp_path, "uniphys/goal-near-alone", {"x": "0.2", "y": y})
        ends.append(float(driven.truth.yaw[-1]))
        for request in driven.planner.requests[:4]:  # while the robot has not turned far yet
            assert aside(driven.planner, request, "goal", (0.2, 0.4), (0.2, -0.4)) > 0.03
    assert ends[0] > 0.3
    assert ends[1] < -0.3


def test_a_velocity_over_the_ground_is_gone_by_its_own_cost_alone(tmp_path: Path) -> None:
    driven = by_its_row(tmp_path, "uniphys/velocity-alone", {"speed": "0.25"})
    assert driven.truth.displacement[-1, 0] > 0.15
    for request in driven.planner.requests[2::6]:
        assert aside(driven.planner, request, "ground", (0.0, 0.25), (0.0, -0.25)) > 0.03
