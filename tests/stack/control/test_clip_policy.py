"""A clip as a policy: played once, from the pose that the robot is in, on any body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_clips import walking_in_a_circle

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import SHIPPED
from servoid.stack.control.clip import ClipPolicy
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.policies import make_policy
from servoid.stack.log.flightlog import read_log
from servoid.stack.tasks import load_task
from servoid.tools.cli import main

ROBOT = load_robot()
CLIP = walking_in_a_circle(ROBOT)
STILL = Instruction(np.zeros(3))


def test_it_enters_plays_and_stays_in_the_last_pose_in_each_world() -> None:
    fleet = Fleet(ROBOT, 2, None)
    fleet.reset(np.ones(2, bool))
    policy = ClipPolicy(ROBOT, CLIP, (2,))
    policy.reset(None, np.zeros(2, int))
    applied = np.stack([ROBOT.home, ROBOT.home + 0.2])
    targets = []
    for tick in range(2 * CLIP.ticks):
        if tick == CLIP.ticks:
            policy.reset(np.array([False, True]), np.zeros(2, int))
        targets.append(policy.act(fleet.observe(), applied, STILL))
    np.testing.assert_allclose(targets[0], applied, atol=1e-9)
    np.testing.assert_allclose(targets[-1][0], CLIP.joints[-1], atol=1e-9)
    one, other = np.array(targets)[CLIP.ticks :, 0], np.array(targets)[CLIP.ticks :, 1]
    assert np.ptp(one) < np.ptp(ROBOT.home) + 1e-6
    assert np.abs(np.diff(one, axis=0)).max() < 1e-9, "it plays once"
    assert np.abs(np.diff(other, axis=0)).max() > 1e-3, "and anew where an episode begins"


def test_a_clip_that_begins_lying_is_no_policy_of_a_run() -> None:
    path = str(SHIPPED / "get-up-back.safetensors")
    with pytest.raises(ConfigError, match="'get-up-back' begins lying on the back, and a run begins standing"):
        make_policy(path, ROBOT, load_task("stand", {}, ROBOT.dt), False)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["sim", "virtual"])
def test_the_robot_bows_by_the_file_of_the_clip(tmp_path: Path, backend: str) -> None:
    path = tmp_path / "bow.mcap"
    words = ["run", "stand", "--policy", str(SHIPPED / "bow.safetensors"), "--seconds", "5", "--backend", backend]
    assert main([*words, "--fast", "--record", str(path)]) == 0
    log = read_log(path)
    assert log.header["policy"]["checkpoint_sha256"]
    running = np.array([message["phase"] == "running" for message in log.messages["/command"]])
    tilt = np.arccos(-log.column("/state", "gravity")[:, 2])[-len(running) :][running[-len(log.ticks("/state")) :]]
    elbow = log.column("/command", "position")[running, ROBOT.names.index("l_el")]
    assert np.ptp(elbow) > 0.5, "its arms move"
    assert 0.1 < tilt.max() < 0.4, "it bows"
    assert tilt[-1] < 0.15
