"""Whole runs on the simulated backend: repeatable, at any pace, and safe at the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.hw.contracts.body import Mode
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.stack.log.flightlog import read_log
from servoid.stack.log.format import MACHINE_DEPENDENT
from servoid.stack.runtime.run import RunSettings, Script, run
from servoid.stack.safety.event import Event
from servoid.stack.safety.phase import Phase

ROBOT = load_robot("op3")


def record(path: Path, **changes):
    settings = RunSettings(
        **({"task": "walk", "policy": "gait", "seconds": 3.0, "seed": 5, "set": {"push": "0.1"}} | changes), record=path
    )
    return run(settings), read_log(path)


def content(log):
    return {
        channel: [
            {key: value for key, value in message.items() if key not in (MACHINE_DEPENDENT.get(channel) or ())}
            for message in messages
        ]
        for channel, messages in log.messages.items()
        if MACHINE_DEPENDENT.get(channel, ()) is not None
    }


@pytest.mark.slow
def test_the_same_seed_is_the_same_run_and_another_is_not(tmp_path):
    _, first = record(tmp_path / "a.mcap", randomise=True)
    _, second = record(tmp_path / "b.mcap", randomise=True)
    _, other = record(tmp_path / "c.mcap", randomise=True, seed=6)
    assert content(first) == content(second)
    assert content(first)["/observation"] != content(other)["/observation"]


@pytest.mark.slow
def test_real_time_has_the_same_result(tmp_path):
    _, fast = record(tmp_path / "a.mcap", seconds=1.0)
    slow_result, slow = record(tmp_path / "b.mcap", seconds=1.0, realtime=True)
    assert content(fast) == content(slow)
    assert slow_result.late_p99_ms > 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "seed"),
    [*(("gait", seed) for seed in range(4)), *((name, seed) for name in ("expert", "diffusion") for seed in (0, 1))],
)
def test_interrupted_while_walking_it_is_lowered_upright_then_off(policy, seed):
    """Lowered in mid step, the expert tipped over more often than not."""
    stop = 130 + int(np.random.default_rng(seed).integers(100))
    body = SimBackend(ROBOT, seed=seed)
    lowering, modes = [], []

    def watch(record):
        modes.append(record.command.mode)
        if record.phase in (Phase.STOPPING, Phase.LOWERING):
            lowering.append((float(body.truth.tilt[0]), float(body.truth.position[0, 2])))

    script = Script((Event(stop, 0.0, "interrupt", None, "Ctrl-C"),))
    speed = "0.1" if policy == "gait" else "0.25"
    settings = RunSettings("walk", policy=policy, seed=seed, seconds=20.0, set={"vx": speed})
    result = run(settings, backend=body, on_tick=watch, script=script)
    assert result.outcome == "interrupted"
    assert max(tilt for tilt, _ in lowering) < np.radians(15)
    assert lowering[-1][0] < np.radians(10)
    assert lowering[-1][1] < 0.75 * ROBOT.standing_height
    assert modes[-1] is Mode.OFF


def test_the_estimate_starts_upright_and_at_the_origin():
    body = SimBackend(ROBOT, seed=1, randomise=True)
    errors, places = [], []

    def watch(record):
        if record.proposal.instruction is not None:
            errors.append(float(np.arccos(np.clip(record.state.gravity @ body.truth.gravity[0], -1.0, 1.0))))
            places.append(record.state.displacement[:2])

    run(RunSettings("stand", policy="gait", seed=1, seconds=0.5), backend=body, on_tick=watch)
    assert errors[0] < np.radians(3)
    assert np.linalg.norm(places[0]) < 0.005


def test_a_fallen_robot_is_damped_and_the_run_says_so():
    body = SimBackend(ROBOT, seed=0)

    def shove(record):
        if record.proposal.instruction is not None:
            body.push(np.array([0.15, 0.0]))

    result = run(RunSettings("stand", policy="gait", seconds=10.0), backend=body, on_tick=shove)
    assert result.outcome == "fell"
    assert not result.success
    assert result.trace.fallen


def test_python_api_in_ten_lines():
    poses = []
    result = run(
        RunSettings(task="walk", policy="gait", seconds=2.0, seed=1, set={"vx": "0.1"}),
        on_tick=lambda record: poses.append(record.observation.position),
    )
    assert result.outcome == "succeeded"
    assert result.ticks == 101
    assert len(poses) > result.ticks
