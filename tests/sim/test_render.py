"""What a film shows beside the robot is in its pictures."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawing import draws

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.sim.marks import Frame
from servoid.sim.render import render


@pytest.mark.slow
@pytest.mark.parametrize("way", ["egl", "osmesa"])
def test_marks_ghosts_and_shadows_are_drawn(way: str) -> None:
    """In a process of its own: MuJoCo chooses how to draw when it is first imported."""
    if not draws(way):
        pytest.skip(f"MuJoCo itself cannot draw with {way} on this machine")
    found = os.pathsep.join(str(Path(__file__).parents[2] / folder) for folder in ("src", "tests/support"))
    environment = os.environ | {"MUJOCO_GL": way, "PYTHONPATH": found}
    done = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def draw() -> None:
    """Check pictures with one mark each against one without."""
    robot, upright = load_robot(), np.array([1.0, 0, 0, 0])
    bare = Frame(np.array([0, 0, 0.26]), upright, robot.home)
    ghost = replace(bare, place=np.array([0.0, 0.3, 0.26]))
    marked = {
        "path": replace(bare, path=np.array([[0.0, 0.2], [0.3, 0.3], [0.3, 0.6]])),
        "push": replace(bare, push=np.array([0.0, -0.5])),
        "ghost": replace(bare, ghosts=(ghost,)),
    }
    plain = picture(bare)
    for name, frame in marked.items():
        assert changed(picture(frame), plain) > 0.0008, name
    near, far = (replace(bare, goal=np.array([0.0, 0.3]), reach=reach) for reach in (0.05, 0.2))
    assert changed(picture(far), picture(near)) > 0.01  # the circle is as large as the task says
    dark = picture(bare, shadows=True)
    assert 0.002 < ((plain - dark).sum(-1) > 60).mean() < 0.3
    away = replace(bare, place=np.array([8.0, 3.0, 0.26]))  # the shadow goes with the robot
    assert 0.002 < ((picture(away) - picture(away, shadows=True)).sum(-1) > 60).mean() < 0.3


def picture(frame: Frame, shadows: bool = False) -> Array:
    return next(iter(render(load_robot(), [frame], 320, 240, shadows))).astype(int)


def changed(one: Array, other: Array) -> float:
    return float((np.abs(one - other).sum(-1) > 30).mean())


if __name__ == "__main__":
    draw()
