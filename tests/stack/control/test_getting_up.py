"""What gets a robot up: the learned policy first, where there is one of this robot, and clips after it."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CHECKPOINTS, CheckpointError
from servoid.policy.mlp import Mlp
from servoid.policy.motion.library import Library
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.rising.lead import CLIPS, PACE, Rising
from servoid.policy.rising.policy import RisingPolicy, save_rising_policy
from servoid.stack.control.get_up import LEARNED_SECONDS, LearnedGetUp, TrackedGetUp, fingerprints, get_up
from servoid.stack.safety.recovery import Recovery

ROBOT = load_robot()
LIBRARY = Library(ROBOT)
PAIR = (LIBRARY[CLIPS[0]], LIBRARY[CLIPS[1]])
SIZE = TaskObservation(ROBOT, Rising(ROBOT, PAIR).goal).size
ABOUT = {"data": "", "licence": "", "results": {}, "training": {}}
CONFIG = {"goal": "stand", "stride": 2, "reach": [0.3] * len(ROBOT.joints), "lead": asdict(PACE)}


def write(folder: Path, robot: Robot = ROBOT, outputs: int = len(ROBOT.joints) + 1) -> Path:
    """A network that has learned nothing."""
    rng = np.random.default_rng(0)
    layers = [(rng.normal(0.0, 0.05, (SIZE, outputs)).astype(np.float32), np.zeros(outputs, np.float32))]
    path = folder / "get_up.safetensors"
    network = Mlp(layers, np.zeros(SIZE, np.float32), np.ones(SIZE, np.float32))
    save_rising_policy(path, network, robot, CONFIG, ABOUT)
    return path


def lying(front: bool = True, shape: tuple[int, ...] = ()) -> State:
    n = len(ROBOT.joints)
    zero, down = np.zeros((*shape, 3)), np.broadcast_to([1.0 if front else -1.0, 0.0, 0.0], (*shape, 3))
    return State(
        time_ns=0, orientation=np.broadcast_to([1.0, 0, 0, 0], (*shape, 4)), gravity=down, yaw=np.zeros(shape),
        angular_velocity=zero, velocity=zero, displacement=zero,
        position=np.broadcast_to(ROBOT.home, (*shape, n)), joint_velocity=np.zeros((*shape, n)),
        contact=np.zeros((*shape, 2)),
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copy(CHECKPOINTS / "tracker.safetensors", tmp_path)
    return tmp_path


def tries(recovery: Recovery, count: int) -> Recovery:
    recovery.tries = count
    return recovery


def test_a_policy_of_this_robot_has_the_first_try_and_clips_have_the_next(folder: Path) -> None:
    assert type(get_up(ROBOT, folder)) is TrackedGetUp
    policy = RisingPolicy(ROBOT, write(folder), PAIR)
    learned, tracked, recovery = get_up(ROBOT, folder), TrackedGetUp, Recovery(ROBOT)
    assert type(learned) is LearnedGetUp
    state = lying()
    learned.begin()
    first = [learned.act(state, ROBOT.home, tries(recovery, 1)) for _ in range(3)]
    assert np.allclose(first, [policy(state, ROBOT.home) for _ in range(3)])  # type: ignore[arg-type]
    (folder / "get_up.safetensors").unlink()
    by_clip = get_up(ROBOT, folder)
    assert type(by_clip) is tracked
    for one in (learned, by_clip):
        one.begin()
    again = [[one.act(state, ROBOT.home, tries(recovery, 2)) for _ in range(3)] for one in (learned, by_clip)]
    assert np.allclose(again[0], again[1])  # type: ignore[arg-type]


def test_a_try_ends_and_says_why(folder: Path) -> None:
    write(folder)
    learned, recovery = get_up(ROBOT, folder), tries(Recovery(ROBOT), 1)
    learned.begin()
    for _ in range(round(LEARNED_SECONDS * ROBOT.rate)):
        assert learned.act(lying(), ROBOT.home, recovery) is not None
    assert learned.act(lying(), ROBOT.home, recovery) is None
    assert learned.failed == "the learned policy did not end on its feet and still within 6 s"


def test_a_policy_of_another_robot_is_left_alone(folder: Path) -> None:
    write(folder, replace(ROBOT, name="other"))
    assert type(get_up(ROBOT, folder)) is TrackedGetUp
    assert "get_up" not in fingerprints(ROBOT, folder)


def test_a_replay_notices_another_policy(folder: Path) -> None:
    before = fingerprints(ROBOT, folder)
    path = write(folder)
    assert set(fingerprints(ROBOT, folder)) - set(before) == {"get_up"}
    told = fingerprints(ROBOT, folder)["get_up"]
    head, tensors = checkpoint.read(path)
    checkpoint.write(path, {**tensors, "0.bias": tensors["0.bias"] + 1.0}, head)
    assert fingerprints(ROBOT, folder)["get_up"] != told


def test_many_robots_get_up_as_one_does(tmp_path: Path) -> None:
    path = write(tmp_path)
    alone, many = RisingPolicy(ROBOT, path, PAIR), RisingPolicy(ROBOT, path, PAIR, (2,))
    applied: list[Array] = [ROBOT.home, np.tile(ROBOT.home, (2, 1))]
    for _ in range(6):
        one, both = alone(lying(False), applied[0]), many(lying(False, (2,)), applied[1])
        assert np.allclose(both, one)
        applied = [one, both]


def test_a_network_that_decides_other_numbers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="decides 20 numbers, not 21; train it again"):
        RisingPolicy(ROBOT, write(tmp_path, outputs=20), PAIR)
