"""One run, composed: how it ends, what it refuses, and that it leaves the robot safe."""

from __future__ import annotations

import gc
import itertools
import signal

import numpy as np
import pytest
from fake_body import FakeBody, spoiled, tilted

from servoid.hw.config import ConfigError
from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import BackendError, Mode
from servoid.hw.contracts.control import Adopted, Plan
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError
from servoid.stack.control.base import BasePolicy
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, Script, run
from servoid.stack.safety.phase import Phase

ROBOT = load_robot("op3")


@pytest.fixture(autouse=True)
def plain_odometry(monkeypatch):
    """The fake body does not move: what a network adds to its odometry is not what is tested here."""
    monkeypatch.setattr("servoid.stack.runtime.run.odometry_of", lambda robot: (None, None))


class Still(BasePolicy):
    """Proposes the home pose."""

    closed = False

    def reset(self, where, seeds):
        self.calls = 0

    def act(self, state, applied, instruction):
        self.calls += 1
        return self.target(self.calls)

    def target(self, call):
        return ROBOT.home

    def close(self):
        self.closed = True


class Simulated(FakeBody):
    """A fake that counts as simulated, so that it starts itself."""

    simulation = Simulation(truth=None, push=lambda velocity: None)


def stand(body=None, policy=None, seconds=1.0, **kwargs):
    body = body or Simulated(ROBOT)
    policy = policy or Still()
    settings = RunSettings("stand", seconds=seconds, **kwargs.pop("settings", {}))
    return run(settings, backend=body, policy=policy, **kwargs), body, policy


def test_standing_for_a_second_succeeds_and_ends_off():
    result, body, policy = stand()
    assert result.outcome == "succeeded"
    assert result.success
    assert result.ticks == 51  # the first and the last tick of a second
    assert result.metrics["wandered_m"] < 0.02
    assert len(result.trace.yaw) == len(result.trace.yaw_rate) == result.ticks
    assert body.sent[-1].mode is Mode.OFF
    assert body.closed
    assert policy.closed
    phases = [event.text.split(",")[0] for event in result.events if event.kind == "phase"]
    assert phases == ["homing", "ready", "running", "coming to rest", "lowering", "damped"]


def test_after_the_task_a_policy_is_asked_to_stand_and_one_that_fails_then_is_lowered():
    class Last(Still):
        def __init__(self, fails):
            super().__init__()
            self.fails, self.asked = fails, []

        def act(self, state, applied, instruction):
            self.asked.append(instruction)
            if self.fails and len(self.asked) == 55:
                raise RuntimeError("worn out")
            return super().act(state, applied, instruction)

    for fails in (False, True):
        result, body, policy = stand(policy=Last(fails))
        assert result.outcome == "succeeded"
        assert result.ticks == 51
        rest = policy.asked[50:]  # at the task's last tick already: no tick passes without a target
        assert len(rest) == 5 if fails else len(rest) >= 15
        assert all(not one.velocity.any() and one.goal is None and one.text is None for one in rest)
        phases = [event.text for event in result.events if event.kind == "phase"]
        assert phases[-3:] == ["coming to rest", "lowering", "damped"]
        failures = [event.text for event in result.events if event.kind == "policy"]
        assert len(failures) == fails
        assert body.sent[-1].mode is Mode.OFF


def test_it_homes_slowly_from_where_it_is():
    body = Simulated(ROBOT, ROBOT.home + 0.4)
    result, _, _ = stand(body)
    assert result.outcome == "succeeded"
    moves = np.abs(np.diff([command.position for command in body.sent[:40]], axis=0)).max()
    assert moves <= ROBOT.limits.homing_speed * ROBOT.dt + 1e-9


def test_a_second_signal_while_connecting_does_not_break_off_the_closing():
    class Slow(Simulated):
        def connect(self):
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("the signal came too late")

        def close(self):
            signal.raise_signal(signal.SIGINT)
            super().close()

    body = Slow(ROBOT)
    with pytest.raises(KeyboardInterrupt):
        stand(body)
    assert body.closed


def test_a_policy_that_raises_ends_safe_and_is_quoted():
    class Broken(Still):
        def target(self, call):
            if call == 5:
                raise ZeroDivisionError("gait phase")
            return ROBOT.home

    result, body, policy = stand(policy=Broken())
    assert result.outcome == "stopped"
    assert not result.success
    (event,) = [event for event in result.events if event.kind == "policy"]
    assert "ZeroDivisionError: gait phase" in event.text
    assert "test_session.py" in event.text
    assert body.sent[-1].mode is Mode.OFF
    assert policy.closed


def test_a_policy_of_nans_ends_safe():
    class Lost(Still):
        def target(self, call):
            return ROBOT.home * np.nan if call > 5 else ROBOT.home

    result, body, _ = stand(policy=Lost())
    assert result.outcome == "stopped"
    assert body.sent[-1].mode is Mode.OFF
    assert all(np.isfinite(command.position).all() for command in body.sent)


def test_a_fall_is_a_fall():
    body = Simulated(ROBOT)
    count = itertools.count()
    body.spoil = lambda o: tilted(o, 1.4) if next(count) > 100 else o
    result, _, _ = stand(body)
    assert result.outcome == "fell"
    assert result.trace.fallen
    assert body.sent[-1].mode is Mode.OFF


def test_a_sensor_that_dies_stops_the_run():
    body = Simulated(ROBOT)
    count = itertools.count()
    body.spoil = lambda o: spoiled(o, [11]) if next(count) > 100 else o
    result, _, _ = stand(body)
    assert result.outcome == "stopped"
    assert any("l_knee" in event.text for event in result.events)


def test_a_sensor_that_never_answers_is_named_and_nothing_is_sent():
    body = Simulated(ROBOT)
    body.spoil = lambda o: spoiled(o, [11])
    result, _, _ = stand(body)
    assert result.outcome == "stopped"
    assert any("no sample from l_knee" in event.text for event in result.events)
    assert body.sent == []


def test_a_lost_body_is_a_backend_error_and_everything_is_closed():
    body, policy = Simulated(ROBOT), Still()

    def cut(record):
        body.unreachable = record.tick > 50

    with pytest.raises(BackendError):
        stand(body, policy, on_tick=cut)
    assert body.closed
    assert policy.closed


def test_a_real_robot_does_not_move_by_itself():
    body = FakeBody(ROBOT)
    with pytest.raises(ConfigError, match="--start"):
        stand(body)
    assert body.sent == []


def test_a_real_robot_asks_before_anything_is_sent():
    body, asked = FakeBody(ROBOT), []

    def confirm(text):
        asked.append(text)
        assert body.sent == []
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stand(body, confirm=confirm)
    assert "home" in asked[0]
    assert body.sent == []
    assert body.closed


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (RunSettings("stnd"), "did you mean 'stand'"),
        (RunSettings("stand", backend="simm"), "did you mean 'sim'"),
        (RunSettings("stand", policy="gate"), "did you mean 'gait'"),
        (RunSettings("stand", robot="op4"), "op3"),
        (RunSettings("stand", set={"speeed": "1"}), "speeed"),
        (RunSettings("stand", policy="gait", port="/dev/ttyUSB0"), "no port"),
    ],
)
def test_what_is_unknown_is_refused_with_the_remedy(settings, message):
    with pytest.raises(ConfigError, match=message):
        run(settings, policy=None if "policy" in message or settings.policy == "gate" else Still())


def never_connected():
    body = FakeBody(ROBOT)
    body.connect = lambda: pytest.fail("the robot was asked")
    return body


def test_a_log_that_cannot_be_made_is_refused_before_the_robot_is_asked(tmp_path):
    (tmp_path / "run.mcap").write_text("precious")
    for path, why in ((tmp_path / "run.mcap", "already exists"), (tmp_path / "run.mcap" / "b" / "a", "cannot be")):
        with pytest.raises(ConfigError, match=why):
            stand(never_connected(), settings={"record": path, "start": True})
    assert (tmp_path / "run.mcap").read_text() == "precious"


def test_odometry_that_does_not_fit_is_refused_before_the_robot_is_asked(monkeypatch):
    def unfit(robot):
        raise CheckpointError("made for another robot")

    monkeypatch.setattr("servoid.stack.runtime.run.odometry_of", unfit)
    with pytest.raises(CheckpointError):
        stand(never_connected(), settings={"start": True})


def test_pushes_are_refused_where_the_body_cannot_be_pushed():
    with pytest.raises(ConfigError, match="cannot push"):
        run(RunSettings("walk", set={"push": "0.3"}, start=True), backend=FakeBody(ROBOT), policy=Still())


def test_pushes_reach_the_body():
    body, pushes = Simulated(ROBOT), []
    body.simulation = Simulation(truth=None, push=pushes.append)
    run(RunSettings("walk", seconds=3.5, set={"push": "0.3"}), backend=body, policy=Still())
    np.testing.assert_allclose(np.linalg.norm(pushes, axis=1), [0.3, 0.3, 0.3])


@pytest.mark.parametrize("gain", [0.0, -1.0, 2.1, float("nan")])
def test_a_gain_that_servos_cannot_have_is_refused(gain):
    with pytest.raises(ConfigError, match=f"gain: {gain:g} is outside 0 to 2"):
        RunSettings("stand", gain=gain)


def test_the_gain_is_no_setting_of_the_task():
    with pytest.raises(ConfigError, match=r"--set gain=0.6: gain is not a setting of the task: use --gain G"):
        RunSettings("stand", set={"gain": "0.6"})


def test_gain_scales_every_command():
    result, body, _ = stand(settings={"gain": 0.5})
    assert result.success
    assert {gain for command in body.sent for gain in command.gain} == {0.5}


def test_the_log_tells_the_run(tmp_path):
    path = tmp_path / "run.mcap"
    result, body, _ = stand(settings={"record": path, "seed": 7})
    log = read_log(path)
    assert log.complete
    assert log.header["seed"] == 7
    assert log.header["robot"]["name"] == "op3"
    assert log.header["task"]["seconds"] == 1.0
    assert log.result["outcome"] == result.outcome
    sent = [command.position for command in body.sent]
    np.testing.assert_array_equal(log.column("/command", "position")[: len(sent)], sent)
    assert len(log.messages["/instruction"]) == result.ticks
    assert log.messages["/command"][-1]["phase"] == str(Phase.DAMPED)
    assert len(log.messages["/event"]) == len(result.events)


class Planning(Still):
    """Adopts a plan every fourth tick, two ticks after it was asked for; `late` requests come to nothing."""

    adopted = None

    def __init__(self, late=()):
        self.late, self.only = late, None

    def repeat(self, plans):
        self.only = plans

    def reset(self, where, seeds):
        super().reset(where, seeds)
        self.latest_plan, self.notes = None, []

    def target(self, call):
        tick, self.adopted = call - 1, None
        requested = tick - 2
        if requested >= 0 and requested % 4 == 0:
            late = requested in self.late if self.only is None else requested not in self.only
            if late:
                self.notes.append(f"plan of {requested} is late")
            else:
                path = np.array([[0.1, 0.0], [0.2, 0.0]])
                actions = np.tile(ROBOT.home + 0.001 * requested, (2, 1))
                self.latest_plan = Plan(requested, actions, np.zeros((2, 5)), path, 0.01)
                self.adopted = Adopted(requested, tick, self.latest_plan)
        return ROBOT.home if self.latest_plan is None else self.latest_plan.actions[0]

    def take_events(self):
        notes, self.notes = tuple(self.notes), []
        return notes


def test_plans_are_logged_with_their_ticks_and_late_ones_noted(tmp_path):
    path = tmp_path / "run.mcap"
    result, _, _ = stand(policy=Planning(late=(8,)), settings={"record": path})
    log = read_log(path)
    plans = [(m["requested"], m["adopted"]) for m in log.messages["/plan"]]
    assert plans[:3] == [(0, 2), (4, 6), (12, 14)]
    assert [event.text for event in result.events if event.kind == "plan"] == ["plan of 8 is late"]


@pytest.mark.slow
def test_a_script_repeats_which_plans_came_in_time():
    def sent(**kwargs):
        _, body, _ = stand(**kwargs)
        return [command.position for command in body.sent]

    recorded = sent(policy=Planning(late=(8, 20)))
    in_time = {tick: tick + 2 for tick in range(0, 200, 4) if tick not in (8, 20)}
    np.testing.assert_array_equal(sent(policy=Planning(), script=Script(plans=(in_time,))), recorded)
    assert not np.array_equal(sent(policy=Planning()), recorded)


def test_a_log_of_a_run_that_broke_says_so(tmp_path):
    body = Simulated(ROBOT)

    def cut(record):
        body.unreachable = record.tick > 50

    with pytest.raises(BackendError):
        stand(body, on_tick=cut, settings={"record": tmp_path / "run.mcap"})
    log = read_log(tmp_path / "run.mcap")
    assert log.complete
    assert log.result["outcome"] == "error"
    assert "cable" in log.result["error"]


@pytest.mark.slow
def test_garbage_is_collected_again_after_a_real_time_run():
    stand(settings={"realtime": True}, seconds=0.1)
    assert gc.get_freeze_count() == 0


def test_a_full_disk_ends_the_run_safe(tmp_path, monkeypatch):
    from servoid.stack.log import recorder

    class Full:
        def __init__(self, file, *args, **kwargs):
            pass

        def start(self, **kwargs):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder, "Writer", Full)
    result, body, _ = stand(settings={"record": tmp_path / "run.mcap"})
    assert result.outcome == "stopped"
    (event,) = [event for event in result.events if event.kind == "record"]
    assert "No space left on device" in event.text
    assert "free some space" in event.text
    assert body.sent == [] or body.sent[-1].mode is Mode.OFF
