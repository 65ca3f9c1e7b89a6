"""Rollouts count honestly, the same on any number of workers, and any episode can be run again."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.contracts.task import Trace
from servoid.hw.robot.description import load_robot
from servoid.hw.seeds import episode_seed
from servoid.sim.backend import SimBackend
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.guard import Phase
from servoid.tools.cli import main
from servoid.tools.commands import rollout
from servoid.tools.common.ground_truth import GroundTruth
from servoid.tools.evaluate.judge import judge

WORDS = ["walk", "--policy", "gait", "--seconds", "3", "--episodes", "2", "--seed", "3"]
KEYS = {
    "fell_ending_rate",
    "task", "policy", "backend", "robot", "randomised", "episodes", "seed", "success_rate", "success_ci95", "fall_rate",
    "mean_seconds", "metrics", "wall_seconds",
}  # fmt: skip


def options(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    rollout.add_arguments(parser)
    return parser.parse_args([*WORDS, *words])


def rolled(capfd: pytest.CaptureFixture[str], *words: str) -> dict:
    assert rollout.main(options("--json", *words)) == 0
    (line,) = capfd.readouterr().out.splitlines()
    return json.loads(line)


def test_one_and_two_workers_give_the_same_and_all_that_was_promised(capfd: pytest.CaptureFixture[str]) -> None:
    one = rolled(capfd, "--workers", "1")
    two = rolled(capfd, "--workers", "2")
    assert set(one) >= KEYS
    assert one.pop("wall_seconds") > 0
    assert two.pop("wall_seconds") > 0
    assert one == two
    assert (one["task"], one["policy"], one["backend"], one["robot"]) == ("walk", "gait", "sim", "op3")
    assert (one["episodes"], one["seed"], one["randomised"]) == (2, 3, False)
    assert one["mean_seconds"] == pytest.approx(3.0, abs=0.05)
    assert one["success_rate"] + one["fall_rate"] == 1.0
    assert {"velocity_error_mps", "top_speed_mps", "odometry_error_m"} <= set(one["metrics"])


def test_an_episode_can_be_run_again_by_its_seed() -> None:
    seed = episode_seed(3, 1)
    assert seed == episode_seed(3, 1) != episode_seed(3, 0)
    job = RunSettings(task="walk", policy="gait", seconds=2.0, seed=seed, randomise=True, set={"push": "0.1"})
    row = judge(job).row
    backend = SimBackend(load_robot(), seed=seed, randomise=True)
    ground_truth = GroundTruth(backend.simulation, 0.02)
    again = run(job, backend=backend, on_tick=ground_truth)
    assert row["outcome"] == again.outcome
    assert row["seconds"] == again.seconds
    assert row["odometry_error_m"] == ground_truth.odometry_error(again.trace)
    plain = run(job)  # as `servoid run --seed` does it
    np.testing.assert_array_equal(plain.trace.displacement, again.trace.displacement)


def trace(fallen: bool) -> Trace:
    rows = np.zeros((200, 3))
    return Trace(0.02, rows, np.zeros(200), rows, np.zeros(200), rows, fallen)


def test_an_episode_that_cannot_be_done_does_not_take_the_others_with_it(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    done = []

    def episode(job: RunSettings) -> SimpleNamespace:
        if len(done) == 2:
            raise BackendError("the rig did not answer")
        done.append(job.seed)
        row = {
            "seed": job.seed, "success": True, "fell": False, "aborted": False, "fell_ending": False, "seconds": 3.0,
            "metrics": {},
            "odometry_error_m": 0.01,
        }  # fmt: skip
        return SimpleNamespace(row=row)

    monkeypatch.setattr("servoid.tools.evaluate.judge.judge", episode)
    words = [*WORDS, "--json", "--workers", "1", "--episodes"]
    assert main(["rollout", *words, "5"]) == 3
    out, err = capfd.readouterr()
    (line,) = out.splitlines()
    result = json.loads(line)
    assert (result["episodes"], result["success_rate"]) == (2, 1.0)
    assert (result["error"], result["exit_code"]) == ("the rig did not answer", 3)
    assert "the rig did not answer" in err
    assert main(["rollout", *words, "5"]) == 3  # and where none was done, the error alone
    (line,) = capfd.readouterr().out.splitlines()
    assert json.loads(line) == {"error": "the rig did not answer", "exit_code": 3}


def test_many_episodes_take_no_more_memory_than_one() -> None:
    """In a process of its own: what else was freed in this one would be used again, and hide it."""
    code = """
        from pathlib import Path
        from servoid.stack.runtime.run import RunSettings
        from servoid.tools.evaluate.judge import judge
        sizes = []
        for seed in range(6):
            judge(RunSettings("goal", seed=seed, seconds=0.5))
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6)
        print(max(sizes[1:]) - sizes[0])
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 40.0  # MB; 99 where nothing is given back


@pytest.mark.parametrize(
    ("outcome", "fallen", "success", "fell"),
    [
        ("succeeded", False, True, False),
        ("timed_out", False, True, False),  # it believed to have failed, and had not
        ("succeeded", True, False, True),
        ("fell", False, False, True),  # the guard was quicker than the fall
        ("stopped", False, False, False),  # the guard broke it off: no success, however far it came
    ],
)
def test_success_is_by_the_truth_and_only_of_whole_runs(
    monkeypatch: pytest.MonkeyPatch, outcome: str, fallen: bool, success: bool, fell: bool
) -> None:
    result = SimpleNamespace(outcome=outcome, seconds=4.0, trace=trace(False), interrupted=False)
    monkeypatch.setattr("servoid.stack.runtime.run.run", lambda *a, **k: result)
    monkeypatch.setattr(GroundTruth, "trace", lambda self: trace(fallen))
    monkeypatch.setattr(GroundTruth, "odometry_error", lambda self, estimate: 0.01)
    row = judge(RunSettings(task="walk", policy="gait")).row
    assert (row["success"], row["fell"], row["aborted"]) == (success, fell, outcome == "stopped")


def test_a_run_that_is_told_to_end_is_no_episode_even_where_its_task_was_done(monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes while the robot is being lowered: the run has a result, and nothing else would know of it."""
    lowering = []

    def told(record: TickRecord) -> None:
        if record.phase is Phase.LOWERING and not lowering:
            lowering.append(record.tick)
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(GroundTruth, "__call__", lambda self, record: told(record))
    with pytest.raises(KeyboardInterrupt):
        judge(RunSettings(task="stand", policy="gait", seconds=0.5))
    assert lowering


def test_a_run_that_never_began_is_counted_and_not_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    """A randomised robot may fall while it stands up, before the task's first tick."""
    for task in ("walk", "goal", "stand", "text"):
        result = SimpleNamespace(outcome="stopped", seconds=0.0, trace=trace(False), interrupted=False)
        monkeypatch.setattr("servoid.stack.runtime.run.run", lambda *a, result=result, **k: result)
        row = judge(RunSettings(task=task, policy="gait")).row
        assert (row["success"], row["fell"], row["aborted"]) == (False, False, True)
        assert row["metrics"] == ({"followed_share": 0.0} if task == "text" else {})
        good = {
            **row,
            "success": True,
            "aborted": False,
            "fell_ending": False,
            "metrics": {"distance_m": 2.0},
            "odometry_error_m": 0.02,
            "seconds": 4.0,
        }
        summary = rollout.summarise(options(), [row, good], 1.0)
        assert summary["metrics"] == {**row["metrics"], "distance_m": 2.0, "odometry_error_m": 0.02}
        assert (summary["success_rate"], summary["aborted_rate"]) == (0.5, 0.5)
        assert summary["failed_seeds"] == [row["seed"]]


def test_the_witness_sees_the_run_in_the_frame_it_started_in() -> None:
    backend = SimBackend(load_robot(), seed=1)
    ground_truth = GroundTruth(backend.simulation, 0.02)
    half = np.pi / 4  # facing along y
    truth = backend.truth
    instruction = SimpleNamespace(velocity=np.array([0.1, 0, 0]))
    record = SimpleNamespace(proposal=SimpleNamespace(instruction=instruction), phase=Phase.RUNNING)
    nothing = SimpleNamespace(instruction=None)
    truth.qpos[0, :2], truth.qpos[0, 3:7] = (1.0, 2.0), (np.cos(half), 0, 0, np.sin(half))
    ground_truth(record)
    truth.qpos[0, :2] = 1.0, 2.5
    ground_truth(record)
    ground_truth(SimpleNamespace(proposal=nothing, phase=Phase.HOMING, events=()))  # which is not the task
    seen = ground_truth.trace()
    np.testing.assert_allclose(seen.displacement[:, :2], [[0, 0], [0.5, 0]], atol=1e-12)
    np.testing.assert_allclose(seen.yaw, 0.0, atol=1e-12)
    assert not seen.fallen
    assert ground_truth.odometry_error(seen) == 0.0
    truth.qpos[0, 2] = 0.1
    ground_truth(record)
    assert ground_truth.trace().fallen


@pytest.mark.parametrize(
    ("phase", "kinds", "counts"),
    [
        (Phase.READY, (), False),
        (Phase.STOPPING, (), True),
        (Phase.LOWERING, (), True),
        (Phase.DAMPED, (), False),  # it lies down then
        (Phase.FAULT, ("fall",), True),  # the guard saw it first
    ],
)
def test_a_fall_after_the_task_is_one_while_ending(phase: Phase, kinds: tuple[str, ...], counts: bool) -> None:
    backend = SimBackend(load_robot(), seed=1)
    ground_truth = GroundTruth(backend.simulation, 0.02)
    asked, nothing = (SimpleNamespace(instruction=i) for i in (SimpleNamespace(velocity=np.zeros(3)), None))
    ground_truth(SimpleNamespace(proposal=asked, phase=Phase.RUNNING))
    backend.truth.qpos[0, 2] = 0.1
    ground_truth(SimpleNamespace(proposal=nothing, phase=phase, events=[SimpleNamespace(kind=kind) for kind in kinds]))
    assert ground_truth.fell_ending == counts
    assert not ground_truth.trace().fallen


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--episodes", "0"], "--episodes"),
        (["--workers", "-1"], "--workers"),
        (["--policy", "gate"], "gait"),
        (["--set", "vz=1"], "vz"),
        (["--robot", "op4"], "op4"),
    ],
)
def test_bad_choices_are_refused_before_anything_runs(words: list[str], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        rollout.main(options(*words))


def test_a_task_that_a_person_steers_is_no_rollout() -> None:
    arguments = options()
    arguments.task = "steer"
    with pytest.raises(ConfigError, match="servoid run steer"):
        rollout.main(arguments)
