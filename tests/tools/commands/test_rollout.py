"""Rollouts count honestly, the same on any number of workers, and any episode can be run again."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.contracts.task import Trace
from servoid.hw.robot.description import load_robot
from servoid.hw.seeds import episode_seed
from servoid.sim.backend import SimBackend
from servoid.sim.ground import Ground
from servoid.sim.model import build
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.phase import Phase
from servoid.tools.commands import rollout
from servoid.tools.common.compare import summarise
from servoid.tools.common.ground_truth import FirstFall, GroundTruth
from servoid.tools.evaluate.episode import EpisodeJob, EpisodeResult
from servoid.tools.evaluate.judge import judge

WORDS = ["walk", "--policy", "gait", "--seconds", "3", "--episodes", "2", "--seed", "3"]
KEYS = {
    "fell_ending_rate", "falls_by",
    "task", "policy", "backend", "robot", "randomised", "episodes", "seed", "success_rate", "success_ci95", "fall_rate",
    "mean_seconds", "metrics", "wall_seconds",
}  # fmt: skip


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    rollout.add_arguments(parser)
    return parser.parse_args(words)


def options(*words: str) -> argparse.Namespace:
    return parsed(*WORDS, *words)


def rolled(capfd: pytest.CaptureFixture[str], *words: str) -> dict:
    assert rollout.main(options("--json", *words)) == 0
    (line,) = capfd.readouterr().out.splitlines()
    return json.loads(line)


@pytest.mark.slow
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


def test_what_the_robot_cannot_do_is_said_before_it_tries(capfd: pytest.CaptureFixture[str]) -> None:
    words = ["--seconds", "0.2", "--episodes", "1", "--workers", "1", "--set", "vx=9"]
    assert rollout.main(options(*words)) == 0
    assert capfd.readouterr().out.startswith("vx=9 is more than op3 can: 0.5 m/s at most that way")


@pytest.mark.slow
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


class Episodes:
    """Stands in for the episodes: `seconds` by policy and number, and an error after so many of them."""

    def __init__(self, error: BaseException | None = None, after: int = 0, gain: float = 0.0) -> None:
        self.done: list[tuple[str, int]] = []
        self._error, self._after, self._gain = error, after, gain

    def __call__(self, job: EpisodeJob) -> EpisodeResult:
        if self._error is not None and len(self.done) >= self._after:
            raise self._error
        self.done.append((job.settings.policy, job.episode))
        row = {
            "seed": job.settings.seed, "success": True, "fell": False, "aborted": False, "fell_ending": False,
            "fall": None,
            "seconds": 3.0 + job.episode + job.experiment * (0.5 + self._gain * job.episode),
            "metrics": {}, "odometry_error_m": 0.01,
        }  # fmt: skip
        return EpisodeResult(job, row, wall_seconds=0.1)


def trace(fallen: bool) -> Trace:
    rows = np.zeros((200, 3))
    return Trace(0.02, rows, np.zeros(200), rows, np.zeros(200), rows, fallen)


def test_an_episode_that_cannot_be_done_does_not_take_the_others_with_it(
    capfd: pytest.CaptureFixture[str],
) -> None:
    work = Episodes(BackendError("the rig did not answer"), after=2)
    words = ["--json", "--workers", "1", "--episodes", "5"]
    with pytest.raises(BackendError):
        rollout.main(options(*words), work)
    (line,) = capfd.readouterr().out.splitlines()
    result = json.loads(line)
    assert (result["episodes"], result["success_rate"]) == (2, 1.0)
    assert (result["error"], result["exit_code"]) == ("the rig did not answer", 3)
    with pytest.raises(BackendError):
        rollout.main(options(*words), work)  # and where none was done, the error alone
    (line,) = capfd.readouterr().out.splitlines()
    assert json.loads(line) == {"error": "the rig did not answer", "exit_code": 3}


@pytest.mark.slow
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
        print(sizes[-1] - sizes[0])
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 40.0  # MB; 93 where nothing is given back


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


@pytest.mark.slow
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
        summary = summarise([row, good])
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
    ("knee", "tilt", "cause"),
    [
        (0.0, 65.0, "tilted"),
        (2.2, 0.0, "on the ground with l_hip_pitch_link, l_knee_link, r_hip_pitch_link, r_knee_link"),
        (0.0, 0.0, "as the guard saw it"),
    ],
)
def test_a_fall_is_told_by_what_made_it_one(knee: float, tilt: float, cause: str) -> None:
    robot = load_robot()
    model, joints, half = build(robot), np.zeros(len(robot.joints)), np.deg2rad(tilt) / 2
    for side, sign in (("l", 1), ("r", -1)):
        joints[robot.names.index(f"{side}_knee")] = sign * knee
    qpos = model.qpos0.copy()
    qpos[3:7] = np.cos(half), 0, np.sin(half), 0
    qpos[[int(model.joint(name).qposadr[0]) for name in robot.names]] = joints
    qpos[2] = Ground(model).height(qpos)
    assert FirstFall(qpos[:3], qpos[3:7], joints).cause(robot) == cause


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
        (["--policy", "gait", "--policy", "gate"], "gait"),
        (["--fresh"], "--out"),
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


def test_policies_are_compared_on_the_same_seeds(capfd: pytest.CaptureFixture[str]) -> None:
    """A walk's length depends on its seed far more than on the policy: the difference is that of the pairs."""
    words = ["walk", "--policy", "gait,expert", "--episodes", "8", "--workers", "1", "--seconds", "9", "--json"]
    work = Episodes(gain=0.01)
    assert rollout.main(parsed(*words), work) == 0
    out, err = capfd.readouterr()
    result = json.loads(out)
    assert work.done[:4] == [("gait", 0), ("expert", 0), ("gait", 1), ("expert", 1)]
    gait, expert = result["policies"]["gait"], result["policies"]["expert"]
    assert gait["sd"]["mean_seconds"] == pytest.approx(np.std(np.arange(8), ddof=1))
    assert expert["mean_seconds"] == pytest.approx(6.5 + 0.5 + 0.035)
    (difference,) = result["differences"]
    assert (difference["policy"], difference["minus"]) == ("expert", "gait")
    longer = difference["figures"]["mean_seconds"]
    assert (longer["mean"], longer["pairs"]) == (pytest.approx(0.535), 8)
    assert 0.5 < longer["ci95"][0] < 0.535 < longer["ci95"][1] < 0.6
    assert difference["figures"]["success_rate"] == {"mean": 0.0, "ci95": None, "pairs": 8}
    assert "expert minus gait, by seed:" in err
    assert "± standard deviation" in err


@pytest.mark.parametrize(
    ("given", "named"), [(["gait,gait"], "twice"), (["gait", "gait"], "twice"), (["gait,"], "''"), ([""], "''")]
)
def test_a_policy_is_compared_with_another_one(given: list[str], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        rollout.policies(given)


@pytest.mark.slow
def test_a_rollout_with_out_goes_on_where_it_was(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """After Ctrl-C, the figures of what was done; the same command does the others, and another one is refused."""
    words = [*WORDS[:3], "--workers", "1", "--out", str(tmp_path / "out"), "--json", "--episodes", "4"]
    with pytest.raises(KeyboardInterrupt, match="the same command goes on"):
        rollout.main(parsed(*words), Episodes(KeyboardInterrupt(), after=2))
    result = json.loads(capfd.readouterr().out)
    assert (result["episodes"], result["exit_code"]) == (2, 130)
    work = Episodes()
    assert rollout.main(parsed(*words), work) == 0
    assert work.done == [("gait", 2), ("gait", 3)]
    assert json.loads(capfd.readouterr().out)["episodes"] == 4
    _, *lines = (tmp_path / "out" / "gait.jsonl").read_text().splitlines()
    assert [json.loads(line)["episode"] for line in lines] == [0, 1, 2, 3]
    assert {"seed", "success", "metrics"} <= json.loads(lines[0]).keys()
    more = Episodes()
    assert rollout.main(parsed(*words, "--policy", "expert"), more) == 0  # its own episodes are all that is lacking
    assert more.done == [("expert", i) for i in range(4)]
    for other, named in (
        (["--set", "tolerance=0.2"], r"settings\.tolerance"),
        (["--seed", "1"], "seed"),
        (["--gain", "0.9"], "gain"),
        (["--randomise"], "randomise"),
    ):
        with pytest.raises(ConfigError, match=rf"gait\.jsonl: .* of these: {named}; .*--fresh"):
            rollout.main(parsed(*words, *other), Episodes())
    fresh = Episodes()
    assert rollout.main(parsed(*words, "--seed", "1", "--fresh"), fresh) == 0
    assert len(fresh.done) == 4


def test_a_policy_that_changes_meanwhile_ends_the_rollout(tmp_path: Path) -> None:
    """What was kept would be two policies' under one name."""
    mine = tmp_path / "mine.yaml"
    mine.write_text("steps: 2\n")
    done = Episodes()

    def work(job: EpisodeJob) -> EpisodeResult:
        mine.write_text(f"steps: {2 + job.episode}\n")
        return done(job)

    words = ["walk", "--policy", str(mine), "--workers", "1", "--out", str(tmp_path / "out")]
    with pytest.raises(ConfigError, match="changed while episodes ran"):
        rollout.main(parsed(*words), work)
    (kept,) = (tmp_path / "out").glob("mine-*.jsonl")
    assert len(kept.read_text().splitlines()) == 2


def test_a_file_that_holds_no_episodes_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "gait.jsonl").write_text("my notes\n")
    with pytest.raises(ConfigError, match="no file of episodes"):
        rollout.main(parsed(*WORDS, "--out", str(tmp_path)), Episodes())
    assert (tmp_path / "gait.jsonl").read_text() == "my notes\n"
