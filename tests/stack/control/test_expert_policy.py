"""A policy does for one robot what it does for a world of many; the shipped expert stays up."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import load_robot
from servoid.policy import checkpoint
from servoid.policy.references.gait import load_gait
from servoid.policy.tracker.network import gait_of_tracker, written
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.gait import GaitPolicy
from servoid.stack.control.policies import make_policy, policy_fingerprint
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.estimation.odometry import load_odometry
from servoid.stack.tasks import load_task

ROBOT = load_robot()


@pytest.mark.parametrize("kind", [GaitPolicy, ExpertPolicy])
def test_one_robot_acts_as_a_world_of_the_fleet(kind: type) -> None:
    fleet, everything = Fleet(ROBOT, 2, None, seed=3, threads=1), np.ones(2, bool)
    policy, batched = kind(ROBOT), kind(ROBOT, shape=(2,))
    fleet.reset(everything)
    batched.reset(None, fleet.seeds)
    for attempt in range(2):  # a reset makes a used policy new
        policy.reset(None, np.array(attempt))
        if attempt:
            fleet.reset(everything)
            batched.reset(everything, fleet.seeds)
        for tick in range(40):
            state = fleet.observe()
            command = np.array([[0.2, 0.0, 0.3], [0.0, 0.0, 0.0]]) * (tick > 5)
            values = {f.name: getattr(state, f.name) for f in fields(State)}
            one = State(**{name: value if name == "time_ns" else value[0] for name, value in values.items()})
            target = policy.act(one, fleet.applied[0], Instruction(command[0]))
            targets = batched.act(state, fleet.applied, Instruction(command))
            np.testing.assert_allclose(target, targets[0], atol=1e-5)
            fleet.step(targets)
        assert np.abs(targets[0] - ROBOT.home).max() > 0.1


@pytest.mark.slow
def test_the_shipped_expert_stays_up_on_robots_it_does_not_know() -> None:
    """Pushed each second, half of the robots while going backward in a turn, where an older expert fell most."""
    n = 64
    fleet, everything = Fleet(ROBOT, n, load_odometry(ROBOT), randomise=1.0, seed=0), np.ones(n, bool)
    policy = ExpertPolicy(ROBOT, shape=(n,))
    fleet.reset(everything)
    command, fallen = np.tile([[-0.1, 0.05, 0.4], [0.2, -0.05, -0.5]], (n // 2, 1)), ~everything
    for tick in range(8 * ROBOT.rate):
        if tick and tick % ROBOT.rate == 0:
            bearing = np.array([rng.uniform(-np.pi, np.pi) for rng in fleet.rngs])
            fleet.worlds.push(0.3 * np.stack([np.cos(bearing), np.sin(bearing)], -1))
        fleet.drive(policy, command)
        fallen |= fleet.truth.fallen
    assert fallen.mean() <= 0.12


def test_a_tracker_that_learned_another_gait_walks_by_it(tmp_path: Path) -> None:
    head, tensors = checkpoint.read(checkpoint.resolve("expert", ROBOT))
    fast = replace(load_gait("gait-fast"), max_velocity=(0.7, 0.1, 2.0))
    head["config"]["gait"] = dict(written(fast))
    path = tmp_path / "fast.safetensors"
    checkpoint.write(path, tensors, head)
    assert gait_of_tracker(path, ROBOT) == fast
    assert gait_of_tracker(checkpoint.resolve("expert", ROBOT), ROBOT) == load_gait()
    assert policy_fingerprint(str(path))["gait"]["max_velocity"] == [0.7, 0.1, 2.0]
    head["config"]["gait"] = {"cycle": 0.4}
    checkpoint.write(path, tensors, head)
    with pytest.raises(checkpoint.CheckpointError, match="its gait is not one of this program"):
        ExpertPolicy(ROBOT, str(path))


def test_a_file_of_a_gait_is_a_policy_that_walks_by_it() -> None:
    policy = make_policy("gait-fast", ROBOT, load_task("walk", {}), realtime=False)
    assert isinstance(policy, GaitPolicy)
    assert policy_fingerprint("gait-fast")["gait"]["yaw_lead"] == load_gait("gait-fast").yaw_lead
