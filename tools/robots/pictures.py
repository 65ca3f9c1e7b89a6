"""The robot at home and in three other poses, side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.tools.common.output import Report

_SIDE = 480  # pixels of each picture


def poses(robot: Robot, out: Path, report: Report, wrong: tuple[tuple[float, float, float], ...] = ()) -> str | None:
    """Draw the robot at home, lowered, and halfway to both ends of its ranges; returns the file, or None where this
    machine cannot draw. At home red balls are put to the places `wrong` [m], in the base's frame. Call `choose_drawing`
    before MuJoCo is loaded."""
    from servoid.hw.robot.legs import Legs
    from servoid.sim.marks import Frame
    from servoid.sim.render import AZIMUTH, RenderError, render
    from servoid.stack.safety.lowering import lowered_pose

    legs = Legs(robot)
    shown: list[Array] = [robot.home, lowered_pose(robot)]
    shown += [robot.home + 0.5 * (end - robot.home) for end in (robot.lower, robot.upper)]
    try:
        from PIL import Image

        pictures = []
        for number, pose in enumerate(shown):
            height, orientation = legs.stand(pose)
            place = np.array([0.0, 0.0, float(height)])
            frame = Frame(place, orientation, pose, wrong=wrong if number == 0 else ())
            pictures.append(next(iter(render(robot, [frame], _SIDE, _SIDE, azimuth=AZIMUTH))))
        Image.fromarray(np.concatenate(pictures, 1)).save(out)
    except (RenderError, ImportError) as error:
        report.line(f"no picture: {error}")
        return None
    red = ", with red balls where to look" if wrong else ""
    report.line(f"drew {out}: at home{red}, lowered, and halfway to either end of every joint's range")
    return str(out)
