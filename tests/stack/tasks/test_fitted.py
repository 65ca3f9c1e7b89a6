"""Numbers of Servoid's own tasks hold for the shipped robot; others are asked for the same shares of what they can."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from servoid.hw.config import CONFIGS, ConfigError, load_yaml
from servoid.hw.robot.description import load_robot
from servoid.policy.references.gait import Gait, load_gait
from servoid.stack.tasks import load_settings, load_task
from servoid.stack.tasks.base import beyond, fitted
from servoid.stack.tasks.text import TextSettings

ROBOT = load_robot()
TASKS = sorted(path.stem for path in (CONFIGS / "tasks").glob("*.yaml"))
SLOW = replace(ROBOT, name="slow", walking=replace(ROBOT.walking, forward=0.25, backward=0.03, height=0.125))


@pytest.mark.parametrize("name", TASKS)
def test_the_shipped_robot_gets_the_very_numbers_of_the_file(name: str) -> None:
    assert load_settings(name, robot=ROBOT) == load_settings(name)


def test_another_robot_gets_the_same_shares_of_its_speeds_and_height() -> None:
    walk, forest = load_settings("walk", robot=SLOW), load_settings("forest", robot=SLOW)
    assert walk.vx == pytest.approx((-0.1 * 0.2, 0.3 * 0.5))
    assert walk.vy == (-0.1, 0.1)
    assert (forest.approach.speed, forest.field.body) == pytest.approx((0.125, 0.085))
    assert forest.width == load_settings("forest").width, "the forest is the same"


@pytest.mark.parametrize("name", TASKS)
def test_nothing_is_asked_that_a_slower_robot_cannot_do(name: str) -> None:
    assert beyond(load_settings(name, robot=SLOW), SLOW) == []


def test_what_is_typed_is_meant() -> None:
    assert load_settings("walk", {"vx": "0.3"}, SLOW).vx == (0.3, 0.3)


def test_a_robot_names_the_file_of_its_gait(tmp_path: Path) -> None:
    own = (CONFIGS / "policies" / "gait.yaml").read_text().replace("cycle: 0.48", "cycle: 0.72")
    (tmp_path / "mine.yaml").write_text(own)
    text = (CONFIGS / "robots" / "op3.yaml").read_text().replace("mjcf: op3.xml", f"mjcf: {ROBOT.mjcf}")
    (tmp_path / "robot.yaml").write_text(text.replace("gait: gait ", "gait: mine.yaml "))
    robot = load_robot(tmp_path / "robot.yaml")
    assert Gait(robot).settings == load_gait(str(tmp_path / "mine.yaml")) != load_gait()
    assert load_settings("walk", robot=robot).cycle == pytest.approx(0.72)
    assert load_task("goal", robot=robot).cycle == pytest.approx(0.72)


def test_settings_that_do_not_fit_a_robot_are_refused_with_its_name(tmp_path: Path) -> None:
    slow = (CONFIGS / "policies" / "gait.yaml").read_text().replace("cycle: 0.48", "cycle: 4.0")
    (tmp_path / "slow.yaml").write_text(slow)
    robot = replace(ROBOT, name="sloth", gait=str(tmp_path / "slow.yaml"))
    with pytest.raises(ConfigError, match="do not fit sloth: settle: 2 leaves no gait cycle"):
        fitted(load_yaml(CONFIGS / "tasks" / "text.yaml", TextSettings), robot)
