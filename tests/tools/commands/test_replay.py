"""A replay repeats what was recorded, and says what is not as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_planner import write_planner

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.stack.control.policies import policy_fingerprint
from servoid.stack.log.flightlog import as_now, read_log
from servoid.stack.log.format import FORMAT
from servoid.stack.log.recorder import Recorder
from servoid.stack.runtime.run import RunSettings, Script, run
from servoid.stack.safety.event import Event
from servoid.tools.cli import main
from servoid.tools.commands.replay import changes, replay
from servoid.tools.common.pictures.flightpath import plans


@pytest.mark.slow
def test_what_a_policy_is_made_of_is_in_the_log_and_changes_are_named(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("execution_horizon: 6\ndelay: 2\n")
    chosen = RunSettings("walk", policy=str(mine), seconds=0.4, gain=0.9, set={"vx": "0.1"}, record=tmp_path / "a.mcap")
    run(chosen)
    log = read_log(tmp_path / "a.mcap")
    assert changes(log) == []
    assert log.header["policy"]["planner"]["execution_horizon"] == 6
    mine.write_text("execution_horizon: 7\ndelay: 2\n")
    assert changes(log) == ["the file of the planner's settings (those of the log are used)"]
    assert replay(log)[1] is None
    mine.unlink()
    assert changes(log) == ["the file of the planner's settings (those of the log are used)"]
    assert replay(log)[1] is None
    mine.write_text("execution_horizon: 6\ndelay: 2\n")
    for text, change in (
        ("the task's settings", {"task": log.header["task"] | {"every": 4.0}}),
        ("the source", {"git_commit": "another"}),
        ("the odometry's checkpoint", {"policy": log.header["policy"] | {"odometry_sha256": "another"}}),
        ("the policy's checkpoint", {"policy": log.header["policy"] | {"checkpoint_sha256": "another"}}),
    ):
        before = dict(log.header)
        log.header.update(change)
        assert changes(log) == [text]
        log.header.update(before)
    planner = log.header["policy"]["planner"]
    older = {("replan" if key == "execution_horizon" else key): value for key, value in planner.items()}
    assert as_now(log.header | {"policy": log.header["policy"] | {"planner": older}}) == log.header
    del log.header["policy"]["planner"], log.header["policy"]["odometry_sha256"]  # of an older program
    assert changes(log) == []


def test_a_closed_loop_is_repeated_by_the_settings_of_its_log(tmp_path: Path) -> None:
    checkpoint, mine = write_planner(tmp_path / "planner.safetensors", load_robot()), tmp_path / "mine.yaml"
    mine.write_text(f"checkpoint: {checkpoint}\ntracker: ''\nframes: 6\ndelay: 2\n")
    turn = {"sentence": "turn left"}  # which is told as the planner knows it
    run(RunSettings("text", policy=str(mine), seconds=0.4, set=turn, record=tmp_path / "a.mcap"))
    log = read_log(tmp_path / "a.mcap")
    assert log.messages["/plan"]
    assert changes(log) == []
    mine.write_text(f"checkpoint: {checkpoint}\ntracker: ''\nframes: 4\ndelay: 4\n")
    said = ["the file of the closed loop's settings (those of the log are used)"]
    assert changes(log) == said
    mine.unlink()
    assert (changes(log), replay(log)[1]) == (said, None)


@pytest.mark.slow
def test_every_robot_of_a_recorded_scene_plans_with_the_settings_of_the_log(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("execution_horizon: 4\ndelay: 2\n")
    run(RunSettings("cross", policy=str(mine), seconds=0.4, record=tmp_path / "a.mcap"))
    mine.write_text("execution_horizon: 7\ndelay: 1\n")
    assert replay(read_log(tmp_path / "a.mcap"))[1] is None


@pytest.mark.parametrize("words", [["replay"], ["plot"], ["export", "--csv"], ["motions", "import"]])
def test_a_log_that_does_not_say_what_ran_is_refused_by_every_reader(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another program's, or one of a test bench: each reader missed another key, as an internal error."""
    log = tmp_path / "a.mcap"
    whole = {"settings": {"task": "walk"}, "robot": {"joints": [], "rate": 50, "feet": []}}
    Recorder.create(log, {"format": FORMAT, **whole}, wait=True).close({})
    more = ["--name", "a", "--caption", "a", "--licence", "MIT", "--out", "out"] if "import" in words else []
    assert main([*words, str(log), *more]) == 2
    said = capsys.readouterr().err
    assert f"{log}: a log whose header lacks settings.backend, settings.robot" in said
    assert "internal" not in said


def test_a_log_whose_gain_was_a_setting_of_the_task_is_repeated_with_it(tmp_path: Path) -> None:
    """So were all logs until the gain had an option of its own."""
    run(RunSettings("stand", policy="gait", seconds=0.4, gain=0.5, set={"cost.stand": "2"}, record=tmp_path / "a.mcap"))
    log = read_log(tmp_path / "a.mcap")
    before = log.header["settings"] | {"set": {"cost.stand": "2", "gain": "0.5"}}
    del before["gain"]
    now = as_now(log.header | {"settings": before})
    assert now == log.header
    assert replay(replace(log, header=now))[1] is None


@pytest.mark.parametrize("name", ["gait", "expert"])
def test_a_walk_by_the_gait_tells_its_settings(name: str) -> None:
    made_of = policy_fingerprint(name)
    assert made_of["gait"]["cycle"] > 0.0
    assert made_of["planner"] is None
    assert (made_of["checkpoint_sha256"] is None) == (name == "gait")
    with pytest.raises(ConfigError, match="gait"):
        policy_fingerprint("gate")


@pytest.mark.slow
def test_a_run_in_which_no_plan_was_in_time_is_repeated_without_one(tmp_path: Path) -> None:
    """As on a machine that is far too slow for the planner."""
    chosen = RunSettings("walk", seconds=0.6, set={"vx": "0.1"}, record=tmp_path / "a.mcap")
    late = run(chosen, script=Script(plans=({},)))
    assert any("was not ready" in event.text for event in late.events)
    log = read_log(tmp_path / "a.mcap")
    assert not log.messages["/plan"]
    assert replay(log)[1] is None


@pytest.mark.slow
def test_a_clip_that_is_not_the_one_it_was_is_named(tmp_path: Path) -> None:
    for name, turn in (("clip", "0.3"), ("other", "-0.3")):
        turned = {"vx": "0.15", "yaw_rate": turn}
        run(RunSettings("walk", policy="gait", seconds=2.0, set=turned, record=tmp_path / f"{name}.mcap"))
    clip = tmp_path / "clip.mcap"
    chosen = {"clips": str(clip), "count": "1"}
    run(RunSettings("inbetween", policy="gait", set=chosen, record=tmp_path / "a.mcap"))
    log = read_log(tmp_path / "a.mcap")
    assert list(log.header["task_files"]) == [str(clip)]
    assert changes(log) == []
    assert replay(log)[1] is None
    clip.write_bytes((tmp_path / "other.mcap").read_bytes())
    assert changes(log) == ["a file that the task's settings name"]


@pytest.mark.slow
def test_a_walk_that_is_stopped_in_mid_step_is_repeated_and_drawn(tmp_path: Path) -> None:
    """The planner goes on until the robot has come to rest, after the last tick of the task."""
    chosen = RunSettings("walk", seconds=9.0, set={"vx": "0.2"}, record=tmp_path / "a.mcap")
    stopped = run(chosen, script=Script((Event(200, 0.0, "interrupt", None, "Ctrl-C"),)))
    assert stopped.outcome == "interrupted"
    log = read_log(tmp_path / "a.mcap")
    task = len(log.messages["/instruction"])
    assert log.messages["/plan"][-1]["requested"] >= task
    assert replay(log)[1] is None
    assert 0 < len(plans(log)) < len(log.messages["/plan"])
