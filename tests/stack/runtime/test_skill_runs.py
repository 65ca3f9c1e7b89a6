"""Skills in whole runs, in simulation and on the virtual rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.stack.log.flightlog import read_log
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task
from servoid.tools.commands.replay import changes, replay
from servoid.tools.evaluate.judge import judge

ROBOT = load_robot()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["sim", "virtual"])
def test_the_robot_sits_down_rises_and_kicks(backend: str) -> None:
    """A kick while it sits would throw it over: it rises first, which nobody asked for by name."""
    settings = RunSettings("skill", backend=backend, policy="expert", set={"name": "sit-down,kick-right"})
    judged = judge(settings)
    assert judged.row["success"], judged.assignment.criteria(judged.trace)
    low = judged.trace.displacement[:, 2] < 0.6 * ROBOT.standing_height
    assert 2.0 < low.sum() * ROBOT.dt < 6.0
    assert judged.row["metrics"]["joint_rms_rad"] < 0.1


@pytest.mark.slow
def test_a_skill_that_was_not_performed_is_no_success() -> None:
    """One that stands still has kept its place and its feet, too."""
    task = load_task("skill", {"name": "wave"}, ROBOT.dt, ROBOT)
    judged = judge(RunSettings("stand", policy="gait", seconds=11.0))
    unmet = [str(c) for c in task.criteria(judged.trace, task.scenario(np.random.default_rng(0))) if not c.met]
    assert [text.split(",")[0] for text in unmet] == ["joints off the motion"]


@pytest.mark.slow
def test_asked_while_it_lies_it_is_refused_with_the_reason_and_not_begun_when_it_stands_again() -> None:
    body = SimBackend(ROBOT, seed=1)
    ticks = [0]

    def watch(record: TickRecord) -> None:
        ticks[0] += record.proposal.instruction is not None
        if ticks[0] == 20:
            body.push(np.array([1.5, 0.0]))

    settings = RunSettings(
        "skill", policy="gait", seed=1, seconds=14.0, recover=True, set={"name": "bow,clap,bow", "every": "3"}
    )
    result = run(settings, backend=body, on_tick=watch)
    told = [event.text for event in result.events if event.kind == "skill"]
    assert "'bow' is refused: the robot lies; ask again when it stands" in told
    assert "'clap' is refused: the robot lies; ask again when it stands" in told
    begun = [text for text in told if text.endswith("begins")]
    assert begun[0] == "'bow' begins"
    assert "'clap' begins" not in told


@pytest.mark.slow
def test_a_run_of_skills_is_repeated_to_the_bit_and_a_clip_that_changed_is_told(tmp_path: Path) -> None:
    path = tmp_path / "bow.mcap"
    assert run(RunSettings("skill", policy="gait", set={"text": "take a bow"}, record=path)).outcome == "succeeded"
    log = read_log(path)
    assert log.header["skills"]["bow"]["clip_sha256"]
    assert not changes(log)
    assert replay(log)[1] is None
    log.header["skills"]["bow"]["clip_sha256"] = "0"
    assert changes(log) == ["a skill or its clip"]


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({}, "no skill is named: give --set name=wave or --set text='wave'"),
        ({"name": "wav"}, "unknown skill 'wav': did you mean 'wave'"),
        ({"name": "wave", "text": "wave"}, "name, text: give one of them"),
        ({"text": "walk forward"}, "asks to walk .forward.: use servoid run text"),
        ({"text": "kick"}, "does not say with which side"),
    ],
)
def test_a_wish_that_cannot_be_met_is_refused_before_anything_moves(chosen: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run(RunSettings("skill", policy="gait", set=chosen))


def test_a_drawn_sentence_that_is_misunderstood_counts_as_that() -> None:
    task = load_task("skill", {"name": "any", "asked_by": "held_out"}, ROBOT.dt, ROBOT)
    episodes = [task.scenario(np.random.default_rng(seed)) for seed in range(40)]
    assert {len(episode.sentences) for episode in episodes} == {1}
    right = [episode.skills == episode.meant for episode in episodes]
    assert np.mean(right) > 0.8
