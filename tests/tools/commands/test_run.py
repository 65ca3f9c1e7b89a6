"""`servoid run`, `replay`, `plot` and `bench loop` as a person starts them."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from drawing import draws

from servoid.hw.config import ConfigError
from servoid.stack.log.flightlog import read_log
from servoid.tools.cli import main
from servoid.tools.common.pictures.video import VideoError

RUN = ["run", "walk", "--policy", "gait", "--seconds", "2", "--set", "vx=0.1"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def drawn():
    if not (draws("egl") or draws("osmesa")):
        pytest.skip("MuJoCo itself cannot draw on this machine")


def start(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "servoid", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def ends_off(log):
    assert log.messages["/command"][-1]["mode"] == "OFF"


@pytest.mark.slow
def test_json_is_one_object_on_standard_output(capfd):
    assert main([*RUN, "--seed", "2", "--json"]) == 0
    out, err = capfd.readouterr()
    (line,) = out.splitlines()
    values = json.loads(line)
    assert values["outcome"] == "succeeded"
    assert values["seed"] == 2
    assert values["ticks"] == 101
    assert set(values["metrics"]) >= {"velocity_error_mps", "top_speed_mps"}
    assert "tilt" in err
    ends_off(read_log(values["log"]))


@pytest.mark.parametrize(
    ("words", "realtime"),
    [(["walk"], False), (["steer"], True), (["steer", "--json"], True), (["steer", "--fast"], False)],
)
def test_who_steers_is_given_real_time_whoever_reads_the_output(words, realtime, monkeypatch):
    asked = []

    def run(settings, **_):
        asked.append(settings.realtime)
        raise ConfigError("seen")

    monkeypatch.setattr("servoid.stack.runtime.run.run", run)
    assert main(["run", *words]) == 2
    assert asked == [realtime]


@pytest.mark.slow
def test_live_line_summary_and_log_for_a_person(capsys):
    assert main(RUN) == 0
    out = capsys.readouterr().out
    assert "asked +0.10 +0.00 m/s" in out
    assert "goal met after 2.02 s (times count from the start of the task)" in out
    (log,) = [line.split()[-1] for line in out.splitlines() if "log:" in line]
    assert read_log(log).complete


def test_what_the_robot_cannot_do_is_said_before_it_tries(capsys):
    main(["run", "walk", "--policy", "gait", "--seconds", "0.2", "--set", "vx=9"])
    assert capsys.readouterr().out.startswith("vx=9 is more than op3 can: 0.5 m/s at most that way")


def test_a_fall_is_exit_code_1(capsys):
    # Pushes of 3 m/s fell anything.
    assert main(["run", "walk", "--policy", "gait", "--seconds", "5", "--set", "push=3"]) == 1
    assert "the robot fell" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "wlk"], "did you mean 'walk'"),
        ([*RUN[:2], "--policy", "gat"], "did you mean 'gait'"),
        ([*RUN, "--set", "vz=1"], "vz"),
        ([*RUN, "--set", "vy=fast"], "vy"),
        ([*RUN, "--seed", "-1"], "--seed must not be negative, not -1"),
        ([*RUN, "--video", "run.avi"], "ends in .mp4"),
        ([*RUN, "--video", "run.mp4", "--video-size", "1280"], "such as 1280x720"),
        ([*RUN, "--video", "run.mp4", "--video-size", "1281x720"], "even numbers from 120 to 4096"),
        ([*RUN, "--record", "/proc/log.mcap"], "choose another place"),
        ([*RUN, "--seconds", "-3"], "not a positive number"),
        (["run", "cross", "--set", "robots=1"], "robots: must be 2 to 4, not 1"),
        (["run", "cross", "--set", "robots=5"], "robots: must be 2 to 4, not 5"),
        (["run", "cross", "--set", "circle=0.3"], "circle: 0.3 m is too small a radius for 3 robots"),
        (["run", "cross", "--backend", "virtual"], "backend 'virtual' has one robot, but the task needs 3"),
        (["run", "cross", "--backend", "dynamixel", "--port", "x", "--start"], "use --backend sim"),
        (["replay", "nothing.mcap"], "No such file"),
        (["plot", "nothing.mcap"], "No such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1


@pytest.mark.slow
def test_replay_is_identical_and_says_where_a_changed_log_differs(capsys):
    main([*RUN, "--record", "a.mcap", "--set", "push=0.1", "--randomise", "--seed", "4"])
    capsys.readouterr()
    assert main(["replay", "a.mcap", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["identical"]
    assert values["ticks"] > 150
    assert values["changed"] == []

    from servoid.tools.commands import replay

    log = read_log("a.mcap")
    message = log.messages["/command"][150]
    other = log.messages["/command"][151]
    message["position"] = other["position"]
    _, difference = replay.replay(log)
    assert (difference.tick, difference.channel, difference.field) == (150, "/command", "position")


@pytest.mark.slow
def test_what_only_a_program_can_repeat_is_refused(capsys):
    assert main([*RUN, "--record", "a.mcap"]) == 0

    from servoid.tools.commands import replay

    for key, value, message in (
        ("backend", "dynamixel", "only simulated"),
        ("backend", "virtual", "own backend"),
        ("policy", {"name": "MyPolicy"}, "own policy"),
    ):
        log = read_log("a.mcap")
        log.header[key] = value
        with pytest.raises(ConfigError, match=message):
            replay.replay(log)


@pytest.mark.slow
def test_a_truncated_log_replays_as_far_as_it_goes(tmp_path, capsys):
    assert main([*RUN, "--record", "a.mcap"]) == 0
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: len(data) // 2])
    assert main(["replay", "b.mcap"]) == 0
    assert "as far as the log goes" in capsys.readouterr().out
    assert main(["plot", "b.mcap"]) == 0
    assert (tmp_path / "b.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("seed", range(2))
def test_a_signal_at_any_moment_ends_lowered_and_off_and_replays(seed, number, tmp_path, capsys):
    process = start(
        "run", "walk", "--policy", "gait", "--seconds", "600", "--set", "vx=0.1", "--record", "a.mcap", "--json"
    )
    while not (tmp_path / "a.mcap").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    time.sleep(0.05 + np.random.default_rng([seed, number]).uniform(0.0, 0.8))
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert json.loads(out)["outcome"] == "interrupted"
    log = read_log("a.mcap")
    assert log.complete
    assert log.messages["/command"][-1]["phase"] == "damped"
    ends_off(log)
    assert main(["replay", "a.mcap"]) == 0, capsys.readouterr().out


@pytest.mark.slow
def test_two_signals_end_at_once(tmp_path):
    process = start("run", "walk", "--policy", "gait", "--seconds", "600", "--record", "a.mcap")
    while not (tmp_path / "a.mcap").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=120)
    assert process.returncode == 130
    ends_off(read_log("a.mcap"))


@pytest.mark.slow
def test_a_disk_that_fills_up_ends_the_run_safe(tmp_path):
    def small_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))

    process = start(
        "run", "walk", "--policy", "gait", "--seconds", "600", "--record", "a.mcap", "--json", preexec_fn=small_files
    )
    out, err = process.communicate(timeout=120)
    assert process.returncode == 4, err
    values = json.loads(out)
    assert values["outcome"] == "stopped"
    (event,) = [event for event in values["events"] if event["kind"] == "record"]
    assert "free some space" in event["text"]
    phases = [event["text"] for event in values["events"] if event["kind"] == "phase"]
    assert phases[-2:] == ["lowering", "damped"]
    log = read_log("a.mcap")
    assert not log.complete
    assert len(log.ticks("/observation")) > 10


@pytest.mark.slow
@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    "error",
    [
        VideoError("cannot draw on this machine: try MUJOCO_GL=osmesa"),
        ConfigError("a.mcap: cannot be read"),
        OSError(errno.ENOSPC, "No space left on device"),
        ValueError("no such encoder"),
    ],
)
def test_without_a_way_to_draw_the_run_still_succeeds(error, tmp_path, monkeypatch, capsys):
    from servoid.tools.common.pictures import video

    def broken(*_):
        raise error

    monkeypatch.setattr(video, "make_video", broken)
    assert main([*RUN, "--video", "a.mp4"]) == 0
    out = capsys.readouterr().out
    assert f"no video: {error}" in out
    assert "goal met" in out
    assert (tmp_path / "a.png").exists()


@pytest.mark.usefixtures("drawn")
def test_a_picture_that_cannot_be_written_leaves_the_result_alone(tmp_path, monkeypatch, capsys):
    from servoid.tools.common.pictures import video

    monkeypatch.setattr(video, "make_video", lambda *_: None)
    (tmp_path / "a.png").mkdir()
    assert main([*RUN, "--video", "a.mp4", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["outcome"] == "succeeded"
    assert "plot" not in values


def test_a_film_that_cannot_be_written_is_refused_before_anything_moves(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main([*RUN, "--video", "file/a.mp4"]) == 2
    assert "--video file/a.mp4: cannot be written" in capsys.readouterr().err
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.slow
def test_gl_that_does_not_work_is_explained_before_anything_moves(tmp_path):
    process = start(*RUN, "--video", "a.mp4", env=os.environ | {"MUJOCO_GL": "glfw", "DISPLAY": ":99"})
    out, err = process.communicate(timeout=120)
    assert process.returncode == 2, err
    assert err.startswith("servoid: --video: cannot draw on this machine with glfw: try MUJOCO_GL=egl")
    assert not out
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("drawn")
def test_a_goal_run_is_filmed_and_plotted(tmp_path):
    av = pytest.importorskip("av")
    size = ["--video-size", "320x240"]
    process = start("run", "goal", "--policy", "gait", "--seconds", "2", "--video", "a.mp4", *size)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1, err  # two seconds do not reach it
    assert "no video" not in out
    assert "filming: 0 % of " in err
    with av.open(str(tmp_path / "a.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) >= 50
    assert pictures[0].shape == (240, 320, 3)
    assert pictures[10].std() > 10  # something is in it
    assert np.abs(pictures[10].astype(int) - pictures[40]).mean() > 0.1  # and moves
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.slow
def test_bench_loop_measures_real_time(capsys):
    assert main(["bench", "loop", "--seconds", "1", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["hz"] == 50
    assert 0.0 < values["late_p50_ms"] <= values["late_p99_ms"]
    assert values["missed"] >= 0
