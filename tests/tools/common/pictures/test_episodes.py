"""What the episode held is drawn where the robot was, and said in the caption."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.common.pictures import flightpath, panels
from servoid.tools.common.pictures.caption import FilmCaptions
from servoid.tools.common.pictures.panels import Shown

PUSHED = {"vx": "0.1", "push": "0.4", "push_every": "0.5"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def pushed(folder: Path) -> FlightLog:
    run(RunSettings("walk", policy="gait", seconds=1.4, set=PUSHED, record=folder / "pushed.mcap"))
    return read_log(folder / "pushed.mcap")


@pytest.fixture(scope="module")
def path(folder: Path) -> FlightLog:
    run(RunSettings("path", policy="gait", seconds=0.5, record=folder / "path.mcap"))
    return read_log(folder / "path.mcap")


def test_pushes_are_where_and_when_they_came(pushed: FlightLog) -> None:
    start = int(flightpath.task_ticks(pushed)[0])
    pushes = flightpath.pushes(pushed)
    assert list(pushes) == [start + 25, start + 50]  # those that it did not come to are left out
    np.testing.assert_allclose([np.linalg.norm(push) for push in pushes.values()], 0.4)


def test_the_circle_is_the_tasks_tolerance_and_no_radius_of_its_arcs(path: FlightLog) -> None:
    assert path.header["task"]["radius"] == 0.4
    assert flightpath.reach(path) == 0.1
    way = flightpath.path(path)
    assert way is not None
    np.testing.assert_allclose(way[0], [0.0, 0.0], atol=1e-9)
    goals = flightpath.goals(path)
    assert goals is not None
    np.testing.assert_allclose(way[-1] + flightpath.drift(path, -1), goals[-1], atol=1e-6)


def test_keyframes_are_poses_of_the_clip(folder: Path, pushed: FlightLog) -> None:
    chosen = {"clips": str(pushed.path), "count": "1", "keyframes": "2", "interval": "0.2"}
    run(RunSettings("inbetween", policy="gait", set=chosen, record=folder / "between.mcap"))
    log = read_log(folder / "between.mcap")
    start, poses = int(flightpath.task_ticks(log)[0]), flightpath.keyframes(log)
    assert [pose.tick for pose in poses] == [start + 10, start + 20]
    assert flightpath.reach(log) is None  # there is no goal to come near to
    positions = pushed.column("/state", "position")
    for pose in poses:
        row = int(np.abs(positions - pose.joints).max(axis=1).argmin())
        np.testing.assert_allclose(pose.joints, positions[row], atol=1e-6)
        recorded = pushed.column("/state", "gravity")[row]
        w, x, y, z = pose.orientation
        down = [2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1]
        np.testing.assert_allclose(down, recorded, atol=1e-5)


def test_captions_say_run_time_what_is_asked_and_what_happens(pushed: FlightLog) -> None:
    captions, first = FilmCaptions(pushed), int(flightpath.task_ticks(pushed)[0])
    row = int(np.flatnonzero(pushed.ticks("/state") == first + 20)[0])
    assert captions.lines(row) == ["walk with gait on op3, seed 0", "0.40 s   asked +0.10 +0.00 m/s +0.00 rad/s"]
    assert captions.lines(row + 6)[2] == "pushed by 0.40 m/s"
    last = captions.lines(len(pushed.messages["/state"]) - 1)[1]
    assert last.endswith("braking, then torque off")


def test_a_caption_fits_a_narrow_picture(pushed: FlightLog) -> None:
    picture = np.full((120, 160, 3), 90, dtype=np.uint8)
    written = FilmCaptions(pushed).write(picture, 0)
    assert (written[:12, :120] > 200).any()
    assert (written[:, -2:] <= 90).all()  # it is cut before the edge
    assert (written[40:] == 90).all()


@pytest.mark.parametrize(
    ("panel", "lines"),
    [
        (panels.velocity, 6),  # raw, smoothed and asked, forward and to the left
        (panels.yaw_rate, 3),
        (panels.joint("l_knee"), 2),
    ],
)
def test_raw_smoothed_and_asked_are_drawn(pushed: FlightLog, panel: panels.Panel, lines: int) -> None:
    axes = Figure().subplots()
    panel(axes, Shown(pushed))
    assert len(axes.lines) == lines
    assert all(len(line.get_xdata()) > 0 for line in axes.lines)


def test_smoothing_takes_the_gait_out_and_keeps_the_mean(pushed: FlightLog) -> None:
    shown = Shown(pushed)
    count = len(pushed.messages["/state"])
    cycle = round(pushed.header["task"]["cycle"] * pushed.header["robot"]["rate"])
    wave = 0.2 + np.sin(2 * np.pi * np.arange(count) / cycle)
    seconds, means = shown.smoothed(wave)
    np.testing.assert_allclose(means, 0.2, atol=1e-6)
    assert len(seconds) == count - cycle + 1


def test_events_are_named_in_the_plot(pushed: FlightLog) -> None:
    axes = Figure().subplots()
    event = {"tick": 100, "time": 2.0, "kind": "derated", "joint": "l_knee", "text": "its gain goes down"}
    log = FlightLog(pushed.path, pushed.header, pushed.messages | {"/event": [event]}, complete=True)
    panels.tilt(axes, Shown(log))
    assert [text.get_text().strip() for text in axes.texts] == ["weaker joint"]
