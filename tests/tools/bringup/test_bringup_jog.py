"""`servoid bringup jog` and `watch`: what reaches a servo is judged by the goals that the rig accepted."""

from __future__ import annotations

import os
import termios
import threading
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from waiting import type_in

from servoid.hw.contracts.body import Observation
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.robot.description import load_robot
from servoid.sim.model import build
from servoid.sim.rig.in_process import InProcessLine
from servoid.sim.rig.process.control import Control, RigProcess
from servoid.sim.rig.rig import Rig
from servoid.tools.bringup import watch
from servoid.tools.bringup.desk.jogging import IDLE_SECONDS, KEY_SECONDS, SPAN, SPEED, There, Wish, reach, restrict
from servoid.tools.bringup.line import Line
from servoid.tools.cli import main

ROBOT = load_robot()
KNEE = ROBOT.names.index("l_knee")
VIRTUAL = ("--port", "virtual")
TICK = 2 * np.pi / 4096


def goals(rig: RigProcess) -> np.ndarray:
    """Accepted goals of the joints `(n_joints, ticks)` rad, each as often as it was written."""
    accepted = [entry for entry in rig.control.accepted() if entry["register"] == "goal_position"]
    by_joint = [[entry["position"] for entry in accepted if entry["joint"] == i] for i in range(20)]
    return np.array([joint[: min(map(len, by_joint))] for joint in by_joint])


def torque(rig: RigProcess) -> int:
    return sum(servo["torque"] for servo in rig.control.servos())


def test_one_joint_moves_slowly_and_comes_back_and_all_others_stay(rig: RigProcess, bringup: Any) -> None:
    code, answer, err = bringup("jog", "l_knee", "--by", "0.2", *VIRTUAL, "--start")
    assert code == 0, err
    assert answer["cause"] == "task"
    assert answer["highest"] - answer["start"] == pytest.approx(0.2, abs=0.05)
    assert answer["others_moved"] < 0.02
    assert answer["lowest"] > answer["start"] - 0.02, "what it sinks by once torque is off does not count"
    sent = goals(rig)
    assert sent.shape[1] > 100
    assert np.ptp(np.delete(sent, KNEE, axis=0), axis=1).max() <= TICK * 1.01, "another joint was sent somewhere else"
    assert np.ptp(sent[KNEE]) == pytest.approx(0.2, abs=0.01)
    assert sent[KNEE][-1] == pytest.approx(sent[KNEE][0], abs=0.01)
    assert np.abs(np.diff(sent[KNEE])).max() <= SPEED * ROBOT.dt + 1.01 * TICK
    assert torque(rig) == 0


def test_what_will_happen_is_told_before_anything_moves(
    rig: RigProcess, bringup: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    (tmp_path / "nobody").write_text("")
    with (tmp_path / "nobody").open() as nobody:
        monkeypatch.setattr("sys.stdin", nobody)
        code, answer, err = bringup("jog", "l_knee", "--by", "0.2", *VIRTUAL)
    assert code == 2
    assert "Torque will come on at all 20 joints" in err
    # Or nobody can say whether it then moves the wrong way.
    assert "A positive turn of it, with the robot upright: what it carries goes backward (right-hand rule" in err
    assert "give --start" in answer["error"]
    assert rig.control.accepted() == [], "nobody pressed Enter"


def test_a_servo_that_reports_an_error_ends_it(rig: RigProcess, bringup: Any) -> None:
    rig.control.inject("overload", servo="l_knee", at=1.5)
    code, answer, err = bringup("jog", "l_knee", "--by", "0.3", *VIRTUAL, "--start")
    assert code == 4
    assert "l_knee" in err
    assert "overload" in err
    assert torque(rig) == 0
    assert answer["cause"] != "task"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("l_kneee", "--by", "0.1"), "did you mean 'l_knee'"),
        (("l_knee", "--by", "0.5"), "between -0.35 and 0.35 rad"),
        (("l_knee", "--by", "0"), "and not 0"),
    ],
)
def test_wrong_words(bringup: Any, words: tuple[str, ...], said: str) -> None:
    code, answer, _ = bringup("jog", *words, *VIRTUAL, "--start")
    assert code == 2
    assert said in answer["error"]


def test_beyond_the_range_is_refused_before_torque(rig: RigProcess, bringup: Any) -> None:
    rig.control.move({"l_knee": float(ROBOT.upper[ROBOT.names.index("l_knee")]) - 0.1})
    code, answer, _ = bringup("jog", "l_knee", "--by", "0.2", *VIRTUAL, "--start")
    assert code == 2
    assert "l_knee can go from -0.350 to +0.0" in answer["error"]
    assert rig.control.accepted() == []


def test_a_held_key_moves_and_letting_go_stops(
    rig: RigProcess, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """On a terminal, with keys that repeat as a held one does, then silence, then the other way, then q."""
    master, slave = os.openpty()
    over = threading.Event()
    watched = Control(rig.control_path)

    def now() -> int:
        return int(watched.call("hello")["now"])

    def person() -> None:
        """Goes by the rig's time, in which the joint moves: on a busy machine it passes slowly."""
        while termios.tcgetattr(slave)[3] & termios.ICANON and not over.wait(0.1):
            pass  # until keys are read one by one
        for key, seconds in ((b"\x1b[C", 1.2), (b"", 1.6), (b"\x1b[D", 0.6), (b"", 1.6)):
            end = now() + round(seconds * 1e9)
            while now() < end and not over.wait(0.01):
                os.write(master, key)
        os.write(master, b"q")

    class Terminal:
        def isatty(self) -> bool:
            return True

        def fileno(self) -> int:
            return slave

    monkeypatch.setattr("sys.stdin", Terminal())
    hands = threading.Thread(target=person)
    hands.start()
    try:
        code = main(["bringup", "jog", "l_knee", *VIRTUAL, "--start"])
    finally:
        over.set()
        hands.join()
        watched.close()
        os.close(master)
        os.close(slave)
    assert code == 0, capfd.readouterr().err
    knee = goals(rig)[KNEE]
    changes = np.sign(np.where(np.abs(np.diff(knee)) > TICK / 2, np.diff(knee), 0.0))
    moving = np.flatnonzero(changes)
    assert knee.max() - knee[0] > 0.1, "it followed the key"
    top = int(knee.argmax())
    down = moving[moving > top]
    assert down.size, "and went back"
    assert down[0] - top > 20, "it stood still while no key was pressed"
    assert len(knee) - 1 - moving[-1] > 20, "and after the last one"
    assert torque(rig) == 0
    assert "torque is off" in capfd.readouterr().out


# The limits, and what keys mean --------------------------------------------------------------------------------------


def test_limits_of_a_jog_leave_one_joint_a_little_room_and_the_others_none() -> None:
    here = ROBOT.home.copy()
    here[KNEE] = ROBOT.joints[KNEE].range[1] - 0.1
    here[0] = 1.7  # beyond its range: it stays there
    robot = restrict(ROBOT, here, KNEE)
    for i in range(20):
        low, high = reach(robot, i)
        if i == KNEE:
            assert (low, high) == pytest.approx((here[i] - SPAN, here[i] + 0.1 - ROBOT.limits.margin))
        else:
            assert (low, high) == pytest.approx((here[i], here[i]))
    assert robot.limits == replace(ROBOT.limits, joint_speed=SPEED), "no other limit of the guard gives way"


@pytest.mark.parametrize("by", [-0.1, 0.1025, -0.105, 0.349])
@pytest.mark.parametrize(("rate", "missed"), [(10, 0), (20, 0), (33, 0), (50, 0), (50, 1), (50, 2), (200, 0)])
def test_there_and_back_ends_where_it_began(rate: int, missed: int, by: float) -> None:
    """Whatever a tick's way is, also that of a machine which misses ticks, the joint must not swing about its goal."""
    source, angle, path = There(by, 1 / rate), 0.5, []
    way = SPEED * (1 + missed) / rate
    for tick in range(0, 10 * rate, 1 + missed):
        wish = source.wish(tick / rate, angle)
        if wish is Wish.END:
            break
        angle += wish.rate * way
        path.append(angle)
    assert wish is Wish.END
    farthest = max(path, key=lambda angle: abs(angle - 0.5))
    assert farthest == pytest.approx(0.5 + by, abs=way)
    assert path[-1] == pytest.approx(0.5, abs=way)
    moves = np.diff([0.5, *path])
    assert np.count_nonzero(np.diff(np.sign(moves[moves != 0.0]))) == 1, "there and back"


@pytest.mark.parametrize(("by", "start"), [(0.35, 0.004), (-0.35, -0.004), (0.35, 0.0)])
def test_there_and_back_ends_where_the_guard_lets_the_joint_go_no_further(by: float, start: float) -> None:
    """A joint that sagged a little between two reads has less than SPAN left: it must not push at that end for ever."""
    source, angle, wish, farthest = There(by, 0.02), start, Wish.HOLD, start
    for tick in range(400):
        wish = source.wish(tick / 50, angle)
        if wish is Wish.END:
            break
        angle = min(max(angle + wish.rate * SPEED / 50, -SPAN), SPAN)
        farthest = max(farthest, angle, key=abs)
    assert wish is Wish.END
    assert abs(farthest) == pytest.approx(SPAN, abs=SPEED / 50)
    assert angle == pytest.approx(start, abs=SPEED / 50)


def test_a_motion_there_and_back_has_an_end_whatever_the_joint_does() -> None:
    source = There(0.1, 0.02)
    wishes = [source.wish(tick / 50, 0.001 * (tick % 2)) for tick in range(500)]
    assert wishes[0] is Wish.UP
    assert wishes[-1] is Wish.END


def test_a_burst_of_keys_moves_no_further_than_one_and_idleness_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty repeats that a slow line held up and delivered at once must not become a second of motion."""
    from servoid.tools.bringup.desk import jogging

    master, slave = os.openpty()
    monkeypatch.setattr("sys.stdin", os.fdopen(slave, "r", closefd=False))
    try:
        with jogging.Keys() as keys:
            assert keys.wish(0.0, 0.0) is Wish.HOLD
            type_in(master, slave, b"\x1b[C" * 30)
            assert keys.wish(1.0, 0.0) is Wish.UP
            assert keys.wish(1.0 + 0.9 * KEY_SECONDS, 0.0) is Wish.UP
            assert keys.wish(1.0 + 1.1 * KEY_SECONDS, 0.0) is Wish.HOLD
            type_in(master, slave, b"+\x1b[B")
            assert keys.wish(3.0, 0.0) is Wish.DOWN, "the newest counts"
            assert keys.wish(3.0 + IDLE_SECONDS, 0.0) is Wish.END
    finally:
        os.close(master)
        os.close(slave)


# Watch ---------------------------------------------------------------------------------------------------------------


def test_watch_shows_every_servo_and_what_the_bus_lost(rig: RigProcess, bringup: Any) -> None:
    rig.control.inject("corrupt", probability=0.02)
    rig.control.inject("encoder", servo="r_knee", at=3.0)
    code, answer, err = bringup("watch", "--seconds", "4", *VIRTUAL)
    assert code == 0, err
    servos = {servo["joint"]: servo for servo in answer["servos"]}
    assert list(servos) == list(ROBOT.names)
    assert servos["l_knee"]["position"] == pytest.approx(ROBOT.home[KNEE], abs=0.01)
    assert 11.5 < servos["l_knee"]["voltage_min"] <= servos["l_knee"]["voltage"] < 12.5
    assert servos["l_knee"]["state"] == "ok"
    assert servos["r_knee"]["state"] == "encoder"
    assert answer["bus"]["reads"] >= 80
    assert answer["bus"]["bad_crc"] > 0
    assert answer["bus"]["recovered"] > 0
    assert "encoder" in err
    assert torque(rig) == 0


def test_watch_shows_the_imu_and_why_there_is_no_sample_of_it(rig: RigProcess, bringup: Any) -> None:
    """Signs that are wrong must be seen here, and not when the robot falls."""
    code, answer, err = bringup("watch", "--seconds", "0.5", *VIRTUAL)
    assert code == 0, err
    assert np.linalg.norm(answer["imu"]["specific_force"]) == pytest.approx(9.81, abs=0.5)
    assert answer["imu"]["specific_force"][2] > 9.0
    assert "IMU: force " in err
    rig.control.inject("imu_dead")
    _, _, err = bringup("watch", "--seconds", "2", *VIRTUAL)
    assert "IMU: no fresh sample (it measures nothing): check its cable" in err


@pytest.mark.parametrize(
    ("axis", "angle", "turning", "force"),
    [
        ((0, 0, 1), 0.0, 1.0, (0.0, 0.0, 9.81)),  # level, turned left
        ((0, 1, 0), 0.5, 0.0, (-4.7, 0.0, 8.61)),  # nose down
        ((1, 0, 0), -0.5, 0.0, (0.0, -4.7, 8.61)),  # left side down
    ],
)
def test_what_the_page_says_of_the_imu_is_what_physics_does(
    axis: tuple[float, ...], angle: float, turning: float, force: tuple[float, ...]
) -> None:
    """Or signs are "corrected" that were right."""
    model = build(ROBOT)
    data = mujoco.MjData(model)
    mujoco.mju_axisAngle2Quat(data.qpos[3:7], np.array(axis, float), angle)
    data.qvel[5] = turning
    mujoco.mj_inverse(model, data)  # the acceleration is none: it is held
    assert data.sensor("servoid/accelerometer").data == pytest.approx(force, abs=0.05)
    assert data.sensor("servoid/gyro").data[2] == pytest.approx(turning)


def test_watch_counts_more_reads_than_it_keeps_the_times_of(
    rig: RigProcess, bringup: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or a bus that is watched for longer than some minutes seems to lose ever more of its answers."""
    monkeypatch.setattr(watch, "_KEPT", 10)
    assert bringup("watch", "--seconds", "1", *VIRTUAL)[1]["bus"]["reads"] == 21


def test_watch_does_not_hurry_after_reads_that_it_missed() -> None:
    """A terminal that was stopped for a second must not be followed by twenty reads in a burst."""
    line = InProcessLine(Rig(ROBOT))
    watched = watch.Watched(Line(Bus(line, line), line, None), ROBOT)
    watched._clock = line  # its own time, which no wall keeps
    read, times = watched._sensors.read, []

    def slow() -> Observation:
        times.append(line.now_ns())
        if len(times) == 5:
            line.sleep_until(line.now_ns() + 1_000_000_000)
        return read()

    watched._sensors.read = slow  # type: ignore[method-assign]
    watched.run(2.0, None)
    assert np.diff(times).min() > 0.02e9
    assert watched.summary()["bus"]["reads"] == pytest.approx(21, abs=1)


def test_watch_says_which_servo_went_silent(rig: RigProcess, bringup: Any) -> None:
    rig.control.inject("dead", servo="l_el", at=3.0)
    code, answer, _ = bringup("watch", "--seconds", "5", *VIRTUAL)
    assert code == 0
    states = {servo["joint"]: servo["state"] for servo in answer["servos"]}
    assert "silent for" in states["l_el"]
    assert states["l_knee"] == "ok"


def test_watching_leaves_torque_as_it_is(rig: RigProcess, bringup: Any) -> None:
    """A robot that stands must not fall because somebody looked at it."""
    from test_bringup_scan import write

    write(rig, 14, torque_enable=1)
    assert bringup("watch", "--seconds", "1", *VIRTUAL)[0] == 0
    assert torque(rig) == 1


def test_a_table_fits_the_window_and_shows_first_what_is_wrong() -> None:
    """In 24 rows the heading scrolled away, and each picture left one more behind."""
    rows, wrong = [f"servo {i}" for i in range(20)], [i in (3, 19) for i in range(20)]
    assert watch.fitted(rows, wrong, 20) == rows
    shown = watch.fitted(rows, wrong, 6)
    assert shown == ["servo 0", "servo 1", "servo 2", "servo 3", "servo 19", "... 15 more, all ok: enlarge the window"]
    assert watch.fitted(rows, [True] * 20, 6)[-1] == "... 15 more, 15 of them not ok: enlarge the window"
    assert watch.fitted(rows, wrong, 1) == ["... 20 more, 2 of them not ok: enlarge the window"]


@pytest.mark.parametrize("size", [(24, 80), (12, 60), (50, 120)])
def test_each_picture_of_watch_replaces_the_one_before_in_any_window(
    rig: RigProcess, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], size: tuple[int, int]
) -> None:
    rows, columns = size
    monkeypatch.setenv("LINES", str(rows))
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert main(["bringup", "watch", "--seconds", "1.6", *VIRTUAL]) == 0
    first, *others = capfd.readouterr().out.split("\x1b[")
    lines = first.splitlines()
    assert len(lines) < rows
    assert max(map(len, lines)) < columns
    assert lines[0].startswith("joint")
    assert others[0] == f"{len(lines)}F", "up to the heading of the one before"
    assert others[1].startswith("J" + lines[0])
