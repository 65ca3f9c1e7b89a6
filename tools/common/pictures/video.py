"""An MP4 of a recorded run, by the robot's own estimate of where it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.stack.log.flightlog import FlightLog
from servoid.tools.common.pictures import flightpath

FPS = 25


class VideoError(Exception):
    """No video can be made here; the text says what is missing."""


def make_video(log: FlightLog, path: Path, width: int = 640, height: int = 480) -> None:
    """Draw a log's states and write them as H.264. Raises VideoError naming what is missing."""
    try:
        import av
    except ModuleNotFoundError:
        raise VideoError("this needs the 'video' extra: pip install 'servoid[video]'") from None
    from servoid.sim.render import Frame, RenderError, render

    robot = load_robot(log.header["settings"]["robot"])
    if not log.messages["/state"]:
        raise VideoError("the log holds no state")
    ticks, first = log.ticks("/state"), flightpath.task_ticks(log)
    place, orientation = log.column("/state", "displacement"), log.column("/state", "orientation")
    joints, goal, plans = log.column("/state", "position"), flightpath.goal(log), flightpath.plans(log)
    obstacles, robots = flightpath.obstacles(log), flightpath.robots(log)
    rolling = len((log.header.get("scene") or {"spheres": ()})["spheres"])  # the last ones of the obstacles
    pillars = 0 if obstacles is None else obstacles.shape[1] - rolling
    step = max(1, round(robot.rate / FPS))
    frames = []
    # Before the task the odometry frame is another one: the run is shown from where the task begins.
    for row in np.flatnonzero(ticks >= first[0])[::step] if len(first) else range(0, len(ticks), step):
        running = [plan for plan in plans if plan.adopted <= ticks[row]]
        shown = running[-1].path if running and ticks[row] <= first[-1] else None
        frame = Frame(place[row], orientation[row], joints[row], goal, shown)
        now = int(np.clip(np.searchsorted(first, ticks[row]), 0, len(first) - 1)) if len(first) else 0
        if obstacles is not None:
            frame = replace(frame, pillars=obstacles[now][:pillars], spheres=obstacles[now][pillars:])
        if robots is not None:
            frame = replace(frame, robots=robots[now])
        frames.append(frame)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "crf": "23"})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for picture in render(robot, frames, width, height):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode(None))
    except RenderError as error:
        path.unlink(missing_ok=True)
        raise VideoError(str(error)) from error
    except OSError as error:
        raise VideoError(f"{path}: {error}") from error
