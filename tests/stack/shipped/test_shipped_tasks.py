"""The papers' tasks, driven by the policy that ships with its own settings: what each one asks for reaches its plans.

Where two plans are compared, both are of one request and one noise: nothing but what is asked tells them apart. Most of
a way round an obstacle is in the asked velocity here, and the obstacle's own cost moves a plan by fractions of a
millimetre: how far such a cost moves one by itself is in `test_shipped_guidance.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped_runs import ROBOT, Asked, Driven, drive, walked

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Plan, PlanRequest
from servoid.policy.features import raw_layout, to_tokens
from servoid.policy.text.captions import caption
from servoid.policy.trajectory import Trajectory
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks.terms.places import obstacle_cost
from servoid.stack.tasks.terms.weights import Weights

pytestmark = pytest.mark.slow

LAYOUT = raw_layout(len(ROBOT.joints))
SOME = slice(2, None, 5)  # of a run's requests: those that are planned again


def turn(driven: Driven) -> float:
    """By how much the robot really turned [rad]."""
    return float(driven.truth.yaw[-1])


def guided_turn(planner: Asked) -> float:
    """How much further to the left plans turn [rad, mean] if the cost asks for it, than to the right; told the same."""
    turns = []
    for request in planner.requests[SOME]:
        asked, told = request.instruction.velocity, caption(request.instruction.velocity, ROBOT.walking.scale)
        plans = [planner.again(request, text=told, velocity=np.array([*asked[:2], rate])) for rate in (0.5, -0.5)]
        left, right = (float(plan.states[-1, LAYOUT.slice("yaw")][0]) for plan in plans)
        turns.append(left - right)
    return float(np.mean(turns))


def closeness(plan: Plan, request: PlanRequest) -> float:
    """Cost of what the plan predicts, by the obstacles that were told with the request."""
    tokens = to_tokens(plan.states.astype(float), request.states[-1].astype(float), len(ROBOT.joints))
    trajectory: Any = Trajectory.of(tokens[None], len(ROBOT.joints), ROBOT.dt)
    assert request.instruction.obstacles is not None
    return obstacle_cost(trajectory, request.instruction.obstacles, Weights(repulsion=1.0))[0].item()


def share_kept_clear(planner: Asked) -> float:
    """Share of the plans that keep clearer of what they were told to avoid than if they had not been told."""
    asked = planner.requests[SOME]
    clearer = [closeness(planner.again(one), one) < closeness(planner.again(one, obstacles=None), one) for one in asked]
    return float(np.mean(clearer))


def test_goals_to_either_side_are_turned_to_and_come_nearer() -> None:
    left, right = (walked(drive("goal", {"x": "0.2", "y": y})) for y in ("0.5", "-0.5"))
    assert turn(left) > 0.4
    assert turn(right) < -0.4
    for driven in (left, right):
        assert driven.result.metrics["final_distance_m"] < 0.49  # from 0.54 m: most of the time it turns on the spot
        assert guided_turn(driven.planner) > 0.05


def test_a_path_is_followed_and_plans_go_where_it_goes() -> None:
    """The places on it alone are moved: velocity and sentence stay as they were."""
    driven = walked(drive("path"))
    assert driven.result.metrics["path_error_m"] < 0.05
    assert driven.truth.displacement[-1, 0] > 0.15
    for request in driven.planner.requests[SOME]:
        path = request.instruction.path
        assert path is not None
        plans = [driven.planner.again(request, path=np.add(path, [0.0, aside])) for aside in (0.1, -0.1)]
        left, right = (float(plan.path[-1, 1]) for plan in plans)
        assert left - right > 0.005


def test_a_pillar_in_the_way_is_walked_around_and_bends_the_plans() -> None:
    driven = walked(drive("forest", {"places": "0.3,0.02,0.05", "x": "1"}))
    assert driven.truth.touched is False
    assert abs(turn(driven)) > 0.4
    assert share_kept_clear(driven.planner) >= 0.9


def test_a_sphere_is_turned_away_from_and_bends_the_plans() -> None:
    driven = walked(drive("obstacle", {"bearing": "0.5"}))
    assert driven.truth.touched is False
    assert turn(driven) < -0.4
    assert share_kept_clear(driven.planner) >= 0.9


def test_two_that_meet_pass_each_other_and_plans_of_both_heed_the_other() -> None:
    driven = walked(drive("cross", {"robots": "2", "circle": "0.4", "spread": "0"}))
    assert driven.truth.touched is False
    assert len(driven.planners) == 2
    assert driven.truth.displacement[-1, 1] < -0.05  # to the right, as the rule of the way is
    for planner in driven.planners:
        assert share_kept_clear(planner) >= 0.9


def test_velocities_over_the_ground_are_turned_to() -> None:
    """The first is ahead; the second, after a second, to a side."""
    ends = []
    for side in ("1", "-1"):
        driven = walked(drive("velocity", {"every": "1", "settle": "0.3", "speed": "0.25", "turn": side}))
        assert driven.truth.displacement[-1, 0] > 0.15
        assert guided_turn(driven.planner) > 0.05
        ends.append(turn(driven))
    assert ends[0] - ends[1] > 0.3


def test_sentences_alone_say_what_the_robot_does() -> None:
    """No cost guides this task: what sets the runs apart is what the network reads."""
    runs = {text: walked(drive("text", {"sentence": text})) for text in ("walk forward", "stand still", "turn left")}
    assert all(driven.planner.runtime.cost is None for driven in runs.values())
    for text, driven in runs.items():
        assert {request.instruction.text for request in driven.planner.requests} == {text}
    ahead = {text: float(driven.truth.displacement[-1, 0]) for text, driven in runs.items()}
    assert ahead["walk forward"] > 0.15
    assert abs(ahead["stand still"]) < 0.05
    assert abs(turn(runs["stand still"])) < 0.2
    assert turn(runs["turn left"]) > 0.4


def test_who_survives_is_set_going_by_a_sentence_and_then_told_nothing() -> None:
    """It walks on: a robot that comes to rest once it is left alone would last for ever, too."""
    driven = walked(drive("survive", {"told": "1", "vx": "0.25"}, seconds=2.5), ticks=126)
    planner = driven.planner
    assert planner.runtime.cost is None
    told = [request.instruction.text for request in planner.requests]
    assert told == ["walk forward fast" if request.tick < 50 else "" for request in planner.requests]
    assert driven.truth.displacement[-1, 0] - driven.truth.displacement[75, 0] > 0.1  # m in the last second
    last = planner.requests[-1]
    asked = np.array([-0.1, 0.0, 0.8])  # by a velocity that nobody is told of
    np.testing.assert_array_equal(planner.again(last).actions, planner.again(last, velocity=asked).actions)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clips") / "walk.mcap"
    run(RunSettings("walk", policy="expert", seconds=3.0, set={"vx": "0.15", "yaw_rate": "0.3"}, record=path))
    return path


def test_keyframes_are_met_within_the_plans_and_by_the_robot(clip: Path) -> None:
    driven = drive("inbetween", {"clips": str(clip), "count": "1", "keyframes": "4"}, seconds=10.0)
    walked(driven, ticks=4 * 26 + 1)
    assert driven.result.outcome == "succeeded"
    assert driven.result.metrics["mrpe_m"] < 0.1
    planner, seen = driven.planner, set()
    horizon, position = planner.runtime.horizon, LAYOUT.slice("position")

    def off(plan: Plan, tick: int, wanted: Array) -> Array:
        return np.abs(plan.states[tick - 1] - wanted)

    for request in planner.requests[SOME]:
        keyframes = request.instruction.keyframes
        if keyframes is None or keyframes.ticks[0] > horizon:
            continue
        tick, wanted = int(keyframes.ticks[0]), keyframes.states[0]
        seen.add(request.tick + tick)
        with_it, without = planner.again(request), planner.again(request, keyframes=None)
        assert off(with_it, tick, wanted).max() < 1e-4  # of the whole state: places, joints and their velocities
        assert off(without, tick, wanted)[position].max() > 0.01
        assert np.abs(with_it.actions - without.actions).max() > 0.01  # rad: the way there changes, too
    assert seen == {26, 52, 78, 104}
