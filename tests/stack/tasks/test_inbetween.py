"""In-betweening: keyframes are cut from recorded runs, strung together, and given with their ticks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from task_bodies import Drawn, state

from servoid.hw.config import ConfigError
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.features import raw_layout
from servoid.sim.kinematics import joint_places
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task

DT = 0.02
NOTHING = Percept("task", 0.0)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot()


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clips") / "walk.mcap"
    run(RunSettings("walk", policy="gait", seconds=3.0, set={"vx": "0.15", "yaw_rate": "0.3"}, record=path))
    return path


def drawn(clip: Path, robot: Robot) -> Any:
    return Drawn(load_task("inbetween", {"clips": str(clip)}, DT, robot))


def test_keyframes_are_told_with_the_ticks_that_are_left(clip: Path, robot: Robot) -> None:
    task = drawn(clip, robot)
    first = task.instruct(0, state(), NOTHING).keyframes
    assert first.ticks.tolist() == list(range(26, 26 * 9 + 1, 26))
    assert first.states.shape == (9, raw_layout(20).size)
    later = task.instruct(30, state(), NOTHING).keyframes
    assert later.ticks.tolist() == [tick - 30 for tick in first.ticks if tick > 30]
    np.testing.assert_array_equal(later.states, first.states[1:])
    assert not task.done(state())
    assert task.instruct(26 * 9, state(), NOTHING).keyframes is None
    assert task.done(state())


def test_clips_begin_where_the_one_before_ended(clip: Path, robot: Robot) -> None:
    """Moved over the ground alone: joints, heights and velocities stay as they were recorded."""
    log = read_log(clip)
    layout = raw_layout(20)
    frames = drawn(clip, robot).episode.frames
    recorded = log.column("/state", "position")
    for frame in frames:
        assert np.abs(recorded - frame[layout.slice("position")]).max(1).min() < 1e-6
    # Keyframes of one clip are as far apart as the robot walked in half a second, here and between clips.
    places = np.vstack([np.zeros(2), frames[:, layout.slice("displacement")][:, :2]])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() < 0.25 * 0.52


def test_the_asked_velocity_comes_to_the_next_keyframe_in_time(clip: Path, robot: Robot) -> None:
    task = drawn(clip, robot)
    frame = task.episode.frames[0]
    layout = raw_layout(20)
    velocity = task.instruct(0, state(), NOTHING).velocity
    np.testing.assert_allclose(velocity[:2] * 26 * DT, frame[layout.slice("displacement")][:2], atol=1e-9)
    np.testing.assert_allclose(velocity[2] * 26 * DT, frame[layout.slice("yaw")][0], atol=1e-9)


def test_errors_are_zero_on_the_keyframes_and_in_metres(clip: Path, robot: Robot) -> None:
    task = drawn(clip, robot)
    layout, last = raw_layout(20), 26 * 9
    ticks = np.arange(last + 1)
    frames = task.episode.frames[np.clip((ticks + 12) // 26 - 1, 0, 8)]
    none = np.zeros((last + 1, 3))
    perfect = Trace(
        dt=DT,
        displacement=frames[:, layout.slice("displacement")],
        yaw=frames[:, layout.slice("yaw")][:, 0],
        velocity=none,
        yaw_rate=none[:, 0],
        command=none,
        fallen=False,
        joints=frames[:, layout.slice("position")],
    )
    assert task.metrics(perfect) == pytest.approx({"mrpe_m": 0.0, "mjpe_m": 0.0}, abs=1e-9)
    assert task.success(perfect)
    assert not task.success(replace(perfect, fallen=True))
    aside = replace(perfect, displacement=perfect.displacement + np.array([0.0, 0.05, 0.0]))
    assert task.metrics(aside) == pytest.approx({"mrpe_m": 0.05, "mjpe_m": 0.0}, abs=1e-9)
    bent = perfect.joints.copy()
    bent[:, robot.names.index("l_knee")] += 0.2
    assert 0.001 < task.metrics(replace(perfect, joints=bent))["mjpe_m"] < 0.02


def test_joints_are_where_the_robot_s_file_has_them(robot: Robot) -> None:
    places = joint_places(robot, np.zeros((1, 20)))[0]
    np.testing.assert_allclose(places[robot.names.index("l_hip_yaw")], [0.0, 0.035, 0.0], atol=1e-9)
    np.testing.assert_allclose(places[robot.names.index("l_knee")][2], -0.0285 - 0.11015, atol=1e-9)


@pytest.mark.slow
def test_clips_that_cannot_be_used_are_refused(clip: Path, robot: Robot, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no clips: record some"):
        load_task("inbetween", {}, DT).scenario(np.random.default_rng(0))
    with pytest.raises(ConfigError, match=r"gone\.mcap: cannot be read"):
        load_task("inbetween", {"clips": str(tmp_path / "gone.mcap")}, DT)
    with pytest.raises(ConfigError, match=r"its task lasted 15\d ticks; keyframes need more than 260"):
        load_task("inbetween", {"clips": str(clip), "keyframes": "10"}, DT)
    knee = robot.names.index("l_knee")
    stiff = replace(
        robot,
        joints=tuple(replace(j, range=(j.range[0], 0.3)) if i == knee else j for i, j in enumerate(robot.joints)),
    )
    with pytest.raises(ConfigError, match=r"l_knee is at 0\.\d+ rad, outside its limits -0\.314 to 0\.300"):
        load_task("inbetween", {"clips": str(clip)}, DT, stiff)


@pytest.mark.slow
def test_a_run_passes_through_keyframes(clip: Path) -> None:
    result = run(RunSettings("inbetween", policy="gait", set={"clips": str(clip), "count": "1"}))
    assert result.outcome == "succeeded"
    assert result.ticks == 26 * 3 + 1
    assert result.metrics["mrpe_m"] < 0.15
