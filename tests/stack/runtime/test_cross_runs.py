"""Several robots in one world, each under the whole stack."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Mode
from servoid.stack.log.flightlog import read_log
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, Script, prepare, run
from servoid.stack.safety.event import Event
from servoid.stack.safety.phase import Phase
from servoid.tools.cli import main
from servoid.tools.commands import replay
from servoid.tools.common.pictures import flightpath
from servoid.tools.evaluate.judge import judge

NEAR = {"robots": "2", "circle": "0.4", "spread": "0"}  # head-on, so that a run is short
BLIND = NEAR | {"passing.apart": "0.001"}


@pytest.mark.slow
def test_two_that_walk_at_each_other_touch_and_it_is_seen() -> None:
    row = judge(RunSettings("cross", policy="gait", seconds=8.0, set=BLIND)).row
    assert row["metrics"]["touched"] == 1.0
    assert not row["success"]


@pytest.mark.slow
def test_two_that_heed_each_other_get_across() -> None:
    judged = judge(RunSettings("cross", policy="gait", seconds=25.0, set=NEAR))
    assert judged.row["outcome"] == "succeeded"
    assert judged.row["success"]
    assert judged.trace.touched is False
    assert judged.trace.robots is not None
    np.testing.assert_allclose(judged.trace.robots[0, 0], [0.8, 0.0, np.pi], atol=0.06)
    assert np.linalg.norm(judged.trace.robots[-1, 0, :2]) < 0.2  # where the first one came from


@pytest.mark.slow
def test_a_run_is_repeated_from_its_log(tmp_path: Path) -> None:
    settings = RunSettings("cross", policy="gait", seconds=3.0, seed=4, randomise=True, record=tmp_path / "a.mcap")
    run(settings)
    log = read_log(tmp_path / "a.mcap")
    assert replay.replay(log)[1] is None
    seen = flightpath.robots(log)
    assert seen is not None
    assert seen.shape[1:] == (2, 3)
    assert len(log.header["scene"]["robots"]) == 2
    other = run(RunSettings("cross", policy="gait", seconds=1.0, seed=5, randomise=True)).trace.robots
    assert other is not None
    assert not np.allclose(seen[0], other[0], atol=1e-3)


def watched(script: Script = Script(), shove: float = 0.0, **more: Any) -> tuple[Any, Any, list[Any]]:  # noqa: B008
    """A run, its body, and each tick's phase, the robots' tilt and their height; `shove` [m/s] is of robot 2."""
    settings = RunSettings("cross", policy="gait", set={"circle": "0.6"}, **more)
    _, body = prepare(settings)
    world: Any = body
    rows = []

    def watch(record: TickRecord) -> None:
        rows.append((record.phase, world.truth.tilt, world.truth.position[:, 2].copy()))
        if record.phase is Phase.RUNNING and shove and len(rows) % 10 == 0:
            world._worlds.push(np.array([[0.0, 0.0], [0.0, 0.0], [shove, 0.0]]))

    return run(settings, backend=body, on_tick=watch, script=script), world, rows


@pytest.mark.slow
def test_one_that_falls_ends_safe_and_the_run_tells_of_it() -> None:
    result, world, rows = watched(shove=0.6, seconds=40.0)
    assert not result.success
    assert result.seconds < 39.0  # nobody waits for one that has fallen
    (fall, *_) = [event for event in result.events if event.kind == "robot"]
    assert fall.text.startswith("robot 2: ")
    assert [command.mode for command in world._commands] == [Mode.OFF] * 3
    assert [tilt < np.radians(60) for tilt in rows[-1][1]] == [True, True, False]


@pytest.mark.slow
def test_an_interrupt_lowers_all_of_them() -> None:
    result, world, rows = watched(Script((Event(160, 0.0, "interrupt", None, "Ctrl-C"),)), seconds=20.0)
    assert result.outcome == "interrupted"
    assert [command.mode for command in world._commands] == [Mode.OFF] * 3
    _, tilt, height = [row for row in rows if row[0] is Phase.LOWERING][-1]
    assert (tilt < np.radians(10)).all()
    assert (height < 0.75 * world._robot.standing_height).all()


def test_each_robot_needs_a_policy_of_its_own() -> None:
    class Still:
        pass

    with pytest.raises(ConfigError, match="has 3 robots, each with its own policy: name one instead"):
        run(RunSettings("cross"), policy=Still())  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_command_line_runs_it_and_lists_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "cross", "--policy", "gait", "--seconds", "1", "--json"]) == 1
    values = json.loads(capfd.readouterr().out)
    assert values["outcome"] == "timed_out"
    assert values["metrics"]["arrived"] == 0.0
    assert values["metrics"]["apart_m"] > 1.0
    words = ["rollout", "cross", "--policy", "expert", "--seconds", "1", "--episodes", "1", "--workers", "1", "--json"]
    assert main(words) == 0
    values = json.loads(capfd.readouterr().out)
    assert values["success_rate"] == 0.0
    assert values["fall_rate"] == 0.0
    assert values["metrics"]["touched"] == 0.0
    assert main(["tasks", "cross"]) == 0
    assert "2 to 4" in capfd.readouterr().out
