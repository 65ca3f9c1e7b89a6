"""What is written into the pictures of a film: which run it is, the time, what is asked of the robot, what happens."""

from __future__ import annotations

from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.stack.log.flightlog import FlightLog
from servoid.stack.log.format import unpack
from servoid.stack.safety.event import Event
from servoid.tools.common.live import asked
from servoid.tools.common.pictures import flightpath
from servoid.tools.common.summary import COURSE, OUTCOMES, told

_PHASES = {
    "homing": "going to the home pose",
    "ready": "standing",
    "running": "running",
    "stopping": "coming to rest",
    "lowering": "being lowered",
    "damped": "braking, then torque off",
    "fault": "braking, then torque off",
}
_LINGERS = 2.0  # s that an event stays
_LINES = 30  # of text that a picture is high


def heading(log: FlightLog) -> str:
    """Which task, policy, robot and seed a log is of."""
    settings = log.header["settings"]
    policy = log.header["policy"]["name"]  # settings name the default where a program brought its own
    return f"{settings['task']} with {policy} on {settings['robot']}, seed {settings['seed']}"


class FilmCaptions:
    """Lines for each state of a log, by its row."""

    def __init__(self, log: FlightLog) -> None:
        self._ticks, first = log.ticks("/state"), flightpath.task_ticks(log)
        self._rate, self._start = log.header["robot"]["rate"], int(first[0]) if len(first) else 0
        self._heading, self._result = heading(log), log.result
        self._asked = {message["tick"]: _asked(message) for message in log.messages["/instruction"]}
        self._phases = {message["tick"]: str(message["phase"]) for message in log.messages["/command"]}
        self._events = {
            event.tick: told(event, 1.0 / self._rate)
            for event in (Event(**message) for message in log.messages["/event"])
            if event.kind not in COURSE
        }
        for tick, push in flightpath.pushes(log).items():
            self._events[tick] = f"pushed by {float(np.linalg.norm(push)):.2f} m/s"

    def lines(self, row: int) -> list[str]:
        """The run; time of the task and what is asked, or how it ended; and the newest event, where it is fresh."""
        tick = int(self._ticks[row])
        phase = self._phases.get(tick, "")
        doing = self._asked.get(tick) if phase == "running" else None
        if doing is None:
            doing = _PHASES.get(phase, phase)
            if self._result is not None and self._asked and tick >= max(self._asked):
                doing = f"{OUTCOMES[self._result['outcome']].rstrip(',')}; {doing}"
        lines = [self._heading, f"{(tick - self._start) / self._rate:.2f} s   {doing}"]
        fresh = [at for at in self._events if 0 <= tick - at < _LINGERS * self._rate]
        return [*lines, self._events[max(fresh)]] if fresh else lines

    def write(self, picture: Array, row: int) -> Array:
        """The picture `(height, width, 3)` uint8 with the lines on a darker band at its top; too long ones are cut."""
        from PIL import Image, ImageDraw, ImageFont

        lines, (height, width) = self.lines(row), picture.shape[:2]
        step = height // (_LINES - 5)
        font = ImageFont.load_default(size=max(height // _LINES, 9))
        band = step * len(lines) + step // 2
        dark = picture.copy()
        dark[:band] = (dark[:band] * 0.4).astype(np.uint8)
        image = Image.fromarray(dark)
        draw = ImageDraw.Draw(image)
        for number, line in enumerate(lines):
            draw.text((step // 2, step // 4 + number * step), _cut(line, font, width - step), font=font, fill="white")
        return np.array(image)


def _asked(message: dict[str, Any]) -> str:
    goal = unpack(message["goal"]) if "goal" in message else None
    return " ".join(asked(unpack(message["velocity"]), goal, message.get("text")).split())


def _cut(line: str, font: Any, room: float) -> str:
    if font.getlength(line) <= room:
        return line
    while line and font.getlength(line + "...") > room:
        line = line[:-1]
    return line + "..."
