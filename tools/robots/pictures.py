"""The robot at home and in three other poses, side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.tools.common.output import Report

_SIDE = 480  # pixels of each picture


def poses(robot: Robot, out: Path, report: Report) -> str | None:
    """Draw the robot at home, lowered, and halfway to both ends of its ranges; returns the file, or None where this
    machine cannot draw. Call `choose_drawing` before MuJoCo is loaded."""
    from servoid.hw.robot.legs import Legs
    from servoid.sim.marks import Frame
    from servoid.sim.render import RenderError, render
    from servoid.stack.safety.lowering import lowered_pose

    legs = Legs(robot)
    shown: list[Array] = [robot.home, lowered_pose(robot)]
    shown += [robot.home + 0.5 * (end - robot.home) for end in (robot.lower, robot.upper)]
    try:
        from PIL import Image

        pictures = []
        for pose in shown:
            height, orientation = legs.stand(pose)
            frame = Frame(np.array([0.0, 0.0, float(height)]), orientation, pose)
            pictures.append(next(iter(render(robot, [frame], _SIDE, _SIDE))))
        Image.fromarray(np.concatenate(pictures, 1)).save(out)
    except (RenderError, ImportError) as error:
        report.line(f"no picture: {error}")
        return None
    report.line(f"drew {out}: at home, lowered, and halfway to either end of every joint's range")
    return str(out)
