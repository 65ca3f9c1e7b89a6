"""An MP4 of a recorded run, by the robot's own estimate of where it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.stack.log.flightlog import FlightLog
from servoid.tools.common.pictures import flightpath
from servoid.tools.common.pictures.caption import FilmCaptions
from servoid.tools.common.pictures.drawing import SIZE

if TYPE_CHECKING:  # MuJoCo chooses how to draw when it is imported: not before it is known
    from servoid.sim.marks import Frame

FPS = 25
PUSHED = 0.5  # s that the arrow of a push is shown
_GHOSTS = 3  # keyframes that are shown ahead


class VideoError(Exception):
    """No video can be made here; the text says what is missing."""


def make_video(
    log: FlightLog,
    path: Path,
    size: tuple[int, int] = SIZE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Draw a log's states, `size` being width and height, and write them as H.264.

    `progress` is told how many pictures of how many are done. Raises VideoError naming what is missing.
    """
    try:
        import av
    except ModuleNotFoundError:
        raise VideoError("this needs the 'video' extra: pip install 'servoid[video]'") from None
    from servoid.sim.render import RenderError, render

    if not log.messages["/state"]:
        raise VideoError("the log holds no state")
    rows, captions = _rows(log), FilmCaptions(log)
    frames, (width, height) = shown_frames(log, rows), size
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "crf": "23"})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            pictures = render(load_robot(log.header["settings"]["robot"]), frames, width, height)
            for number, (row, picture) in enumerate(zip(rows, pictures, strict=True)):
                progress(number, len(rows))
                told = captions.write(picture, int(row))
                container.mux(stream.encode(av.VideoFrame.from_ndarray(told, format="rgb24")))
            container.mux(stream.encode(None))
    except RenderError as error:
        path.unlink(missing_ok=True)
        raise VideoError(str(error)) from error
    except OSError as error:
        raise VideoError(f"{path}: {error}") from error


def middle_frames(log: FlightLog, count: int, seconds: float = 1.0) -> list[Frame]:
    """So many moments of the middle `seconds` of what a film shows, all of it where that is shorter. Raises ConfigError
    for a log without states."""
    if not log.messages["/state"]:
        raise ConfigError(f"{log.path}: holds no state: the run ended before every sensor was read")
    rows = _rows(log)
    middle, half = len(rows) / 2, min(0.5 * seconds * FPS, len(rows) / 2)
    picked = np.linspace(middle - half, middle + half, count).round().astype(int)
    return shown_frames(log, rows[np.clip(picked, 0, len(rows) - 1)])


def _rows(log: FlightLog) -> Array:
    """Rows of the states that are shown. Before the task the odometry frame is another one: it begins with the task."""
    ticks, first = log.ticks("/state"), flightpath.task_ticks(log)
    step = max(1, round(log.header["robot"]["rate"] / FPS))
    return np.flatnonzero(ticks >= (first[0] if len(first) else 0))[::step]


def shown_frames(log: FlightLog, rows: Array) -> list[Frame]:
    """What a film shows of these rows of the log's states."""
    from servoid.sim.marks import Frame

    ticks, first, plans = log.ticks("/state"), flightpath.task_ticks(log), flightpath.plans(log)
    place, orientation = log.column("/state", "displacement"), log.column("/state", "orientation")
    joints, path, reach = log.column("/state", "position"), flightpath.path(log), flightpath.reach(log)
    goal, goals = flightpath.goal(log), flightpath.goals(log)
    obstacles, robots = flightpath.obstacles(log), flightpath.robots(log)
    pushes, keyframes = flightpath.pushes(log), flightpath.keyframes(log)
    objects = flightpath.objects(log)
    rolling = len((log.header.get("scene") or {"spheres": ()})["spheres"])  # the last ones of the obstacles
    pillars = 0 if obstacles is None else obstacles.shape[1] - rolling
    shown, held = [], PUSHED * log.header["robot"]["rate"]
    for row in rows:
        tick = ticks[row]
        now = int(np.clip(np.searchsorted(first, tick), 0, len(first) - 1)) if len(first) else 0
        running = [plan.path for plan in plans if plan.adopted <= tick] if len(first) and tick <= first[-1] else []
        pushed = [push for at, push in pushes.items() if at <= tick < at + held]
        coming = [pose for pose in keyframes if pose.tick >= tick][:_GHOSTS]
        shown.append(
            Frame(
                place[row],
                orientation[row],
                joints[row],
                goal=goal if goals is None else goals[now],
                plan=running[-1] if running else None,
                pillars=None if obstacles is None else obstacles[now][:pillars],
                spheres=None if obstacles is None else obstacles[now][pillars:],
                objects=() if objects is None else tuple(zip(objects[0], objects[1][now], strict=True)),
                robots=None if robots is None else robots[now],
                reach=reach,
                path=None if path is None else path + flightpath.drift(log, now),
                push=pushed[-1] if pushed else None,
                ghosts=tuple(Frame(pose.place, pose.orientation, pose.joints) for pose in coming),
            )
        )
    return shown
