"""Falls in whole simulated runs: the robot gets up and goes on, or lies still and says why."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fake_body import FakeBody

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Mode
from servoid.hw.contracts.world import Scene, Start
from servoid.hw.robot.description import load_robot, save_robot
from servoid.sim.backend import SimBackend
from servoid.stack.control.base import BasePolicy
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import Result, RunSettings, Script, prepare, run
from servoid.stack.safety.event import Event
from servoid.stack.safety.phase import DOWN, Phase
from servoid.tools.commands.replay import changes, replay
from servoid.tools.common.ground_truth import GroundTruth
from servoid.tools.common.pictures.flightpath import plans

ROBOT = load_robot()
LOW, HIGH = ROBOT.lower + ROBOT.limits.margin, ROBOT.upper - ROBOT.limits.margin
STEP = ROBOT.limits.joint_speed * ROBOT.dt
AT = 60  # the tick of the task at which the robot is pushed over: in mid step
BEARINGS = {"front": 0.0, "back": np.pi, "side": np.pi / 2}
STRAIGHT = {"vx": "0.1", "vy": "0", "yaw_rate": "0"}


class Watch:
    """Pushes the robot over, keeps the ticks, and lets a test do something at each of them."""

    def __init__(self, body: SimBackend, bearing: float, then: Any = None) -> None:
        self.body, self.then, self.records = body, then, list[TickRecord]()
        self.ground_truth = GroundTruth(body.simulation, ROBOT.dt, recover=True)
        self._push = 1.5 * np.array([np.cos(bearing), np.sin(bearing)])
        self._ticks = 0

    def __call__(self, record: TickRecord) -> None:
        self.ground_truth(record)
        self.records.append(record)
        if record.proposal.instruction is not None:
            self._ticks += 1
            if self._ticks == AT:
                self.body.push(self._push)
        if self.then is not None:
            self.then(record)

    @property
    def phases(self) -> list[Phase]:
        """Each phase once, in the order in which they came."""
        return passed(self.records)


def passed(records: list[TickRecord]) -> list[Phase]:
    phases = [record.phase for record in records]
    return [now for before, now in zip([None, *phases], phases, strict=False) if now is not before]


def fall(bearing: float, then: Any = None, seconds: float = 16.0, **more: Any) -> tuple[Result, Watch]:
    chosen = {"seed": 1, "set": STRAIGHT} | more
    script = chosen.pop("script", None)
    body = SimBackend(ROBOT, seed=chosen["seed"], randomise=chosen.get("randomise", False))
    watch = Watch(body, bearing, then)
    settings = RunSettings("walk", policy="gait", seconds=seconds, recover=True, **chosen)
    return run(settings, backend=body, on_tick=watch, script=script), watch


def assert_limits(records: list[TickRecord]) -> None:
    """Range and rate of all that was sent since the robot was brought home, fallen or not."""
    active = [r for r in records if r.command.mode is Mode.ACTIVE and r.phase not in (Phase.HOMING, Phase.READY)]
    goals = np.array([r.command.position for r in active])
    assert ((goals >= LOW - 1e-9) & (goals <= HIGH + 1e-9)).all()
    assert np.abs(np.diff(goals, axis=0)).max() <= STEP + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("bearing", BEARINGS)
def test_pushed_over_while_it_walks_it_gets_up_and_walks_on(bearing: str) -> None:
    result, watch = fall(BEARINGS[bearing])
    assert watch.phases == [
        *(Phase.HOMING, Phase.READY, Phase.RUNNING, Phase.FALLEN, Phase.RECOVERING, Phase.RUNNING),
        *(Phase.STOPPING, Phase.LOWERING, Phase.DAMPED),
    ]
    assert result.outcome == "succeeded"
    assert result.ticks == 16 * ROBOT.rate + 1  # the task's time ran on
    trace, falls = watch.ground_truth.trace(), watch.ground_truth.falls
    assert not trace.fallen
    assert len(trace.yaw) == result.ticks
    assert falls is not None
    assert falls.falls == 1
    assert 0.5 < falls.seconds[0] < 10.0
    assert_limits(watch.records)
    # By what it knows itself: upright, and its heading kept through all that rolling.
    last = next(r.state for r in reversed(watch.records) if r.phase is Phase.RUNNING)
    assert last is not None
    assert -last.gravity[2] > np.cos(0.15)
    off = float(last.yaw) - float(trace.yaw[-1])
    assert abs((off + np.pi) % (2 * np.pi) - np.pi) < 0.3
    assert abs(float(last.yaw)) < np.pi  # no whole turns that it did not make


def test_without_recover_the_same_fall_is_the_end() -> None:
    body = SimBackend(ROBOT, seed=1)
    watch = Watch(body, 0.0)
    result = run(RunSettings("walk", policy="gait", seed=1, set=STRAIGHT, seconds=9.0), backend=body, on_tick=watch)
    assert result.outcome == "fell"
    assert watch.phases[-2:] == [Phase.RUNNING, Phase.FAULT]


def test_time_that_is_over_while_it_lies_is_a_fall() -> None:
    result, watch = fall(0.0, seconds=2.8)
    assert result.outcome == "fell"
    assert result.trace.fallen
    assert watch.ground_truth.trace().fallen
    assert any("has not got up" in event.text for event in result.events)
    assert watch.records[-1].command.mode is Mode.OFF


@pytest.fixture(scope="module")
def fallen() -> list[TickRecord]:
    return fall(0.0, seconds=5.0)[1].records


@pytest.mark.parametrize("phase", sorted(DOWN))
@pytest.mark.parametrize("count", [1, 2])
def test_ctrl_c_while_it_is_down_damps_and_ends_at_once(fallen: list[TickRecord], phase: Phase, count: int) -> None:
    at = next(r.tick for r in fallen if r.phase is phase) + 5
    text = "interrupted: once" if count == 1 else "interrupted twice: torque off at once"
    result, watch = fall(0.0, seconds=5.0, script=Script((Event(at, 0.0, "interrupt", None, text),)))
    assert result.outcome == "interrupted"
    assert result.trace.fallen
    after = [r for r in watch.records if r.tick >= at]
    assert all(r.command.mode is not Mode.ACTIVE for r in after)
    assert len(after) <= (0.5 * ROBOT.rate if count == 1 else 1)


class Table:
    """A ball of a metre that nothing moves, and that comes down on the robot once it is told to."""

    def __init__(self, start: Start | None = None) -> None:
        self.radius, self.lowest, self._ticks = 1.0, 0.1, 0
        scene = Scene(np.zeros((0, 3)), np.array([[5.0, 0.0, self.radius, 0.0]]))
        self.body = SimBackend(ROBOT, seed=1, scene=scene, start=start)

    def press(self) -> None:
        self._ticks += 1
        x, y, _ = self.body.truth.position[0]
        height = self.radius + max(self.lowest, 0.3 - 0.02 * self._ticks)
        self.body._worlds.move(0, np.array([[x, y, height]]))


@pytest.mark.parametrize("bearing", ["front", "back"])
def test_pressed_from_above_it_lies_still_and_says_why(bearing: str) -> None:
    """As under a table: it comes down when the robot begins to get up."""
    table, down = Table(), list[int]()

    def press(record: TickRecord) -> None:
        if record.phase is Phase.RECOVERING or down:
            down.append(record.tick)
            table.press()

    watch = Watch(table.body, BEARINGS[bearing], press)
    settings = RunSettings("walk", policy="gait", seed=1, set=STRAIGHT, seconds=16.0, recover=True)
    assert_left_lying(run(settings, backend=table.body, on_tick=watch), watch.records)


def test_pressed_from_above_as_it_begins_it_is_left_lying_too() -> None:
    """On the way home it gives way to what presses it, and is stopped when it pushes against that to get up."""
    settings = RunSettings("get-up", policy="gait", seed=1, set={"lying": "anyhow"}, recover=True)
    table, records = Table(prepare(settings)[0].episode.start), list[TickRecord]()

    def press(record: TickRecord) -> None:
        records.append(record)
        table.press()

    assert_left_lying(run(settings, backend=table.body, on_tick=press), records)


def assert_left_lying(result: Result, records: list[TickRecord]) -> None:
    assert result.outcome == "stopped"
    assert result.trace.fallen
    assert any("does not move: is it blocked?" in event.text for event in result.events if event.kind == "overload")
    assert passed(records)[-2:] == [Phase.RECOVERING, Phase.DAMPED], "no further try"
    assert records[-1].command.mode is Mode.OFF


class Limp(BasePolicy):
    """Falls by itself, again and again: it pulls its legs away."""

    def __init__(self) -> None:
        self.resets = 0

    def reset(self, where: Any, seeds: Any) -> None:
        self.resets += 1

    def act(self, state: Any, applied: Any, instruction: Any) -> Any:
        ankles = np.array(["ank_pitch" in name for name in ROBOT.names])
        return np.where(ankles, np.where(ROBOT.home > 0, ROBOT.upper, ROBOT.lower), ROBOT.home)


@pytest.mark.slow
def test_each_fall_has_its_tries_and_the_policy_begins_anew_after_each() -> None:
    policy = Limp()
    body = SimBackend(ROBOT, seed=1)
    watch = Watch(body, 0.0)
    watch.body = body
    run(RunSettings("stand", seed=1, seconds=30.0, recover=True), backend=body, policy=policy, on_tick=watch)
    again = watch.phases.count(Phase.RUNNING) - 1
    assert again >= 2
    assert policy.resets == 1 + again


def place_at(log: FlightLog, tick: int) -> Any:
    """Where the robot believed to be at a tick `(2,)` m."""
    return log.column("/state", "displacement")[log.ticks("/state").tolist().index(tick), :2]


@pytest.mark.slow
def test_a_run_with_a_fall_is_repeated_to_the_bit(tmp_path: Any) -> None:
    """By the planner: its plans count from when it begins, and here it begins twice."""
    path = tmp_path / "a.mcap"
    chosen = {"vx": "0.1", "push": "1.5", "push_every": "11"}
    settings = RunSettings("walk", seconds=21.5, seed=3, set=chosen, recover=True, record=path)
    result = run(settings)
    again = next(event.tick for event in result.events if event.text == "running again")
    log = read_log(path)
    assert {"fallen", "recovering"} <= {message["phase"] for message in log.messages["/command"]}
    first, then = (
        [message["requested"] for message in log.messages["/plan"] if (message["tick"] > again) is late]
        for late in (False, True)
    )
    assert set(first) & set(then)
    assert all(np.abs(plan.path[0] - place_at(log, plan.adopted)).max() < 0.1 for plan in plans(log))
    assert sorted(log.header["recovery"]) == ["get-up-back", "get-up-front", "get_up", "tracker"]
    assert changes(log) == []
    assert replay(log)[1] is None
    log.header["recovery"]["get-up-back"] = "another"
    assert changes(log) == ["what it gets up by"]


def test_a_robot_that_cannot_get_up_or_know_that_it_fell_is_refused_before_anything_moves(tmp_path: Any) -> None:
    other = tmp_path / "other.yaml"
    no_imu, faster = replace(ROBOT, imu=replace(ROBOT.imu, kind="none")), replace(ROBOT, rate=100)
    for text, robot in (("no IMU", no_imu), ("no clips", faster)):
        save_robot(robot, other)
        with pytest.raises(ConfigError, match=f"--recover: op3 has {text}"):
            run(RunSettings("walk", policy="gait", robot=str(other), recover=True))


def test_several_robots_do_not_recover() -> None:
    with pytest.raises(ConfigError, match="several robots"):
        run(RunSettings("cross", policy="gait", recover=True))


def test_the_prompt_at_a_real_robot_says_that_it_gets_up_by_itself() -> None:
    asked: list[str] = []

    def confirm(text: str) -> None:
        asked.append(text)
        raise KeyboardInterrupt

    for recover in (False, True):
        with pytest.raises(KeyboardInterrupt):
            run(RunSettings("stand", policy="gait", recover=recover), backend=FakeBody(ROBOT), confirm=confirm)
    assert "gets up" not in asked[0]
    assert "if it lies or falls, it gets up by itself" in asked[1]
