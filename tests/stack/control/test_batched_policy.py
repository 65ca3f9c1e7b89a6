"""One diffusion policy for many worlds: each is planned for as a robot by itself, and may begin anew between."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from test_diffusion_policy import INSTRUCTION, ROBOT, Spy, state

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Plan, PlanRequest, State
from servoid.stack.control.diffusion import DiffusionPolicy
from servoid.stack.control.planning.plan_buffer import Pace
from servoid.stack.control.planning.trim import Trim


def marked(asked: PlanRequest) -> Plan:
    """A plan whose action for tick t is 1000 * its own tick + t, and 100000 more for each number of the seed."""
    actions = 1000.0 * asked.tick + asked.tick + np.arange(16.0)[:, None] * np.ones(20)
    actions = actions + 1e5 * np.asarray(asked.seeds)[..., None, None]
    shape = asked.states.shape[:-2]
    return Plan(asked.tick, actions, np.zeros((*shape, 16, 53)), np.zeros((*shape, 16, 2)), 0.0)


def spy() -> Spy:
    made = Spy()
    made._answer = marked
    return made


def many(one: State, n: int) -> State:
    values = {f.name: getattr(one, f.name) for f in fields(State)}
    return State(**{k: v if k == "time_ns" else np.repeat(np.asarray(v)[None], n, 0) for k, v in values.items()})


def asked(n: int) -> Instruction:
    return Instruction(np.tile(INSTRUCTION.velocity, (n, 1)))


def run(policy: DiffusionPolicy, ticks: range, applied: Array) -> Array:
    """The first joint's targets `(ticks, n)`, the guard accepting everything."""
    out = []
    for tick in ticks:
        applied = policy.act(many(state(tick), len(applied)), applied, asked(len(applied)))
        out.append(applied[:, 0])
    return np.stack(out)


def test_a_world_of_many_acts_as_a_robot_by_itself() -> None:
    alone, together, single, batch = spy(), spy(), [], np.full((3, 20), 0.5)
    policy = DiffusionPolicy(alone, Pace(4, 4, 2))
    policy.reset(None, np.array(2))
    applied = batch[0]
    for tick in range(14):
        applied = policy.act(state(tick), applied, INSTRUCTION)
        single.append(applied[0])
    worlds = DiffusionPolicy(together, Pace(4, 4, 2), shape=(3,))
    worlds.reset(None, np.array([0, 1, 2]))
    targets = run(worlds, range(14), batch)
    np.testing.assert_array_equal(targets[:, 2], single)
    assert (targets[6:, 1] - targets[6:, 0] == 1e5).all()
    for ours, theirs in zip(together.requests, alone.requests, strict=True):
        np.testing.assert_array_equal(ours.states[2], theirs.states)
        np.testing.assert_array_equal(ours.actions[2], theirs.actions)
        assert ours.ages is not None
        assert ours.ages[2] == theirs.ages == ours.tick


def test_a_world_that_begins_among_others_holds_its_pose_until_a_plan_that_knows_of_it() -> None:
    planner = spy()
    policy = DiffusionPolicy(planner, Pace(4, 4, 2), shape=(2,))
    policy.reset(None, np.array([0, 1]))
    run(policy, range(9), np.full((2, 20), 0.5))
    policy.reset(np.array([False, True]), np.array([7, 7]))  # while the plan of tick 8 is on its way
    targets = run(policy, range(9, 18), np.array([[0.5] * 20, [-0.25] * 20]))
    assert targets[:, 0].tolist() == [4009, 8010, 8011, 8012, 8013, 12014, 12015, 12016, 12017]
    assert targets[:5, 1].tolist() == [-0.25] * 5
    assert targets[5:, 1].tolist() == [712014, 712015, 712016, 712017]  # by its new seed, and not by the other's
    knows = planner.requests[2]
    assert knows.tick == 12
    assert knows.ages is not None
    assert knows.ages.tolist() == [12, 3]
    np.testing.assert_array_equal(knows.actions[1], np.full((5, 20), -0.25))  # it stood still in its past
    height = 2
    np.testing.assert_allclose(knows.states[1, :, height], np.array([9, 10, 11, 12]) / 100, rtol=1e-6)


def test_what_is_asked_is_corrected_world_by_world_and_has_the_name_of_its_correction() -> None:
    planner = spy()
    policy = DiffusionPolicy(planner, Pace(4, 2, 1), trim=Trim(ROBOT, 5.0, (2,)), shape=(2,))
    turning = replace(many(state(0), 2), angular_velocity=np.tile([0.0, 0.0, 0.4], (2, 1)))
    command = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    for _ in range(200):
        policy.act(turning, np.tile(ROBOT.home, (2, 1)), Instruction(command))
    instruction = planner.requests[-1].instruction
    assert (instruction.velocity[:, 2] < -0.2).all()
    assert instruction.text is None
