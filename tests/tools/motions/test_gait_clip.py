"""A clip of the gait: a cycle that leads on to itself, and what data of one velocity are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.policy.references.clip import ClipReference
from servoid.policy.references.gait import gait_of
from servoid.tools import cli
from servoid.tools.learn.collect.skills import Commands
from servoid.tools.learn.envs.starts import AlongClip
from servoid.tools.motions.verbs.derive.gait import cycle

ROBOT = load_robot()


def test_a_clip_of_the_gait_loops_and_goes_at_the_speed_asked_for(tmp_path: Path) -> None:
    assert cli.main(["motions", "gait", "--name", "walk", "--velocity", "0.3", "0", "0", "--out", str(tmp_path)]) == 0
    clip = Library(ROBOT, tmp_path)["walk"]
    assert clip.joints[0] == pytest.approx(clip.joints[-1], abs=1e-6)
    seconds = (clip.ticks - 1) * ROBOT.dt
    assert seconds == pytest.approx(gait_of(ROBOT).cycle)
    assert clip.root_position[-1, 0] / seconds == pytest.approx(0.3, abs=0.01)
    assert 0.9 < clip.root_position[:, 2].mean() / ROBOT.walking.height < 1.1
    reference = ClipReference(ROBOT, [clip])
    ahead = reference.frames(np.array([0, clip.ticks - 1]))
    assert ahead.position[0] == pytest.approx(ahead.position[1])
    start = AlongClip(ROBOT, clip, 0.0, 0).draw([np.random.default_rng(0)], np.ones(1, bool))
    assert start.joints == pytest.approx(ROBOT.home[None])  # a loop has no first pose


@pytest.mark.parametrize(
    ("velocity", "message"), [((0.0, 0.0, 0.0), "a robot that stands has no gait"), ((2.0, 0.0, 0.0), "op3 goes from")]
)
def test_what_is_no_walk_is_refused(velocity: tuple[float, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        cycle(ROBOT, "walk", np.array(velocity))


def test_one_velocity_is_asked_after_it_stood() -> None:
    commands = Commands(ROBOT, 4, always=(0.3, 0.0, 0.0))
    commands.begin(np.arange(4))
    rngs = [np.random.default_rng(i) for i in range(4)]
    commands.advance(rngs)
    assert not commands.velocity.any()
    for _ in range(400):
        commands.advance(rngs)
        assert {tuple(row) for row in commands.velocity} <= {(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)}
    assert commands.velocity == pytest.approx(np.tile([0.3, 0.0, 0.0], (4, 1)))
