"""A policy of a user's own, in a file: run, recorded and replayed as any other, and refused with file and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.stack.control.policies import check_policy, make_policy, names, policy_fingerprint
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task
from servoid.tools.commands import replay

STILL = """
from servoid.stack.control.base import BasePolicy


class Still(BasePolicy):
    def __init__(self, robot):
        self.home = robot.home

    def act(self, state, applied, instruction):
        return self.home
"""


def test_it_is_run_and_its_file_is_in_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file, record = tmp_path / "still.py", tmp_path / "log.mcap"
    file.write_text(STILL)
    result = run(RunSettings("stand", policy="still.py:Still", seconds=1.0, record=record))
    assert result.outcome == "succeeded"
    log = read_log(record)
    assert log.header["policy"]["source"]["file"] == str(file)
    monkeypatch.chdir("/")  # where its name means nothing
    assert replay.changes(log) == []
    assert replay.replay(log)[1] is None
    file.write_text(STILL + "\n")
    assert replay.changes(log) == ["the policy's file"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            STILL.replace("(BasePolicy)", ""),
            r"still\.py:5: .*not a policy: extend servoid\.stack\.control\.base\.BaseP",
        ),
        (STILL.replace("self, robot", "self, robot, speed"), r"still\.py:5: Still\(robot\): .*missing 1 required"),
        ("", r"still\.py:1: there is no class 'Still'; known: none"),
    ],
)
def test_what_cannot_be_made_is_refused(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "still.py").write_text(content)
    with pytest.raises(ConfigError, match=words):
        make_policy(str(tmp_path / "still.py:Still"), load_robot(), load_task("stand"), realtime=False)


def test_an_unknown_policy_is_still_refused_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="unknown policy 'expret': did you mean 'expert'"):
        check_policy("expret")


def test_a_file_that_is_no_policy_is_told_which_files_are(tmp_path: Path) -> None:
    film = tmp_path / "walk.mp4"
    for said in ("no such file", "no file of a policy"):
        with pytest.raises(ConfigError, match=rf"walk\.mp4: {said}: .*\.safetensors.*\.yaml.*FILE\.py:Class.*uniphys"):
            check_policy(str(film))
        film.touch()


def test_the_shipped_settings_of_the_planner_are_policies_by_name() -> None:
    assert {"diffusion", "uniphys", "diffuse_cloc"} <= {*names()}
    assert policy_fingerprint("uniphys")["planner"]["steps"] == 5
    assert policy_fingerprint("gait")["planner"] is None, "whose file has another form"
