"""ROBOTIS action files: pages of joint goals with times, played as the robot's own firmware plays them.

A file holds 256 pages of 512 bytes: a header of 64, and 7 steps of 64. A page says which one comes next, so that a long
motion is a chain of pages. Names, offsets and timing are those of the manufacturer's action editor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot

PAGES, PAGE_BYTES, STEP_BYTES, STEPS = 256, 512, 64, 7
UNIT = 0.008  # s: the firmware's cycle
_CENTRE, _TURN = 2048, 4096  # encoder ticks
_NO_GOAL, _NO_TORQUE = 0x4000, 0x2000  # instead of a goal
_TIME_SCHEDULE = 10  # a step's time is its duration; otherwise it is a speed
_SPEED = 32  # plays a page as its times say


@dataclass(frozen=True)
class PageStep:
    goals: Mapping[int, int]  # servo ID -> encoder ticks
    time: int  # units
    pause: int  # units, after it


@dataclass(frozen=True)
class Page:
    """One page. Times are in units of `UNIT`, with the page's speed in them."""

    number: int
    name: str
    repeat: int
    acceleration: int  # units that speeding up and slowing down take
    next: int  # page, or 0
    steps: tuple[PageStep, ...]


def read_pages(path: Path) -> dict[int, Page]:
    """The pages of a file that hold a motion, by their numbers. Raises ConfigError naming the page that is wrong."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    if len(content) != PAGES * PAGE_BYTES:
        whole = PAGES * PAGE_BYTES
        raise ConfigError(f"{path}: has {len(content)} bytes instead of {whole}: cut off, or not an action file")
    pages = {}
    for number in range(PAGES):
        raw = content[number * PAGE_BYTES : (number + 1) * PAGE_BYTES]
        if raw[20] == 0:
            continue
        if sum(raw) & 0xFF != 0xFF:
            raise ConfigError(f"{path}: page {number}: its checksum is wrong: the file is damaged")
        pages[number] = _page(path, number, raw)
    if not pages:
        raise ConfigError(f"{path}: none of its pages holds a motion")
    return pages


def _page(path: Path, number: int, raw: bytes) -> Page:
    count, schedule, speed = raw[20], raw[16], raw[22]
    if count > STEPS:
        raise ConfigError(f"{path}: page {number}: has {count} steps, but only {STEPS} fit")
    if schedule != _TIME_SCHEDULE:
        raise ConfigError(
            f"{path}: page {number}: its steps are timed by speed, which is not supported yet: save it timed by time"
        )
    if speed == 0:
        raise ConfigError(f"{path}: page {number}: its play speed is 0")
    steps = []
    for i in range(count):
        step = raw[64 + i * STEP_BYTES : 64 + (i + 1) * STEP_BYTES]
        words = np.frombuffer(step[:62], "<u2")
        goals = {id: int(word) for id, word in enumerate(words) if not word & (_NO_GOAL | _NO_TORQUE)}
        steps.append(PageStep(goals, time=(step[63] * speed) // _SPEED, pause=(step[62] * _SPEED) // speed))
    name = raw[:14].split(b"\0")[0].decode("ascii", "replace").strip()
    return Page(number, name, max(raw[15], 1), raw[24], raw[25], tuple(steps))


def chain(pages: Mapping[int, Page], first: int, path: Path) -> list[Page]:
    """The page `first` and those that follow it. Raises ConfigError for an empty one, and for a chain that loops."""
    followed: list[Page] = []
    number = first
    while number:
        if number not in pages:
            asked = f"page {number}" + (f", which page {followed[-1].number} goes on with," if followed else "")
            raise ConfigError(f"{path}: {asked} is empty; pages with a motion: {', '.join(map(str, pages))}")
        if any(page.number == number for page in followed):
            raise ConfigError(f"{path}: the pages from {first} on loop at page {number}, so the motion never ends")
        followed.append(pages[number])
        number = pages[number].next
    return followed


def joint_goals(pages: list[Page], robot: Robot, start: Array) -> Array:
    """Joint goals `(ticks, n_joints)` rad at the robot's rate, from the pose `start` on, as the firmware goes.

    Each joint speeds up to the speed of its step, keeps it, and slows down at its end, unless it goes on in the same
    direction in the next step: then it passes through. Goals are servo angles about their centres. A joint without a
    goal stays where it is.
    """
    ids = {joint.id: i for i, joint in enumerate(robot.joints)}
    here, speed = np.array(start, dtype=float), np.zeros(len(ids))
    samples = [here.copy()]
    steps = [(step, page.acceleration) for page in pages for _ in range(page.repeat) for step in page.steps]
    goals, at = [], here
    for step, _ in steps:
        at = at.copy()
        for id, encoder in step.goals.items():
            if id in ids:
                at[ids[id]] = (encoder - _CENTRE) * 2 * np.pi / _TURN
        goals.append(at)
    for i, (step, acceleration) in enumerate(steps):
        way = goals[i] - here
        onward = goals[i + 1] - goals[i] if i + 1 < len(steps) and step.pause == 0 else np.zeros_like(way)
        passes = way * onward > 0.0
        part = min(acceleration, max((step.time - 1) // 2, 0))
        path, speed = _trapezoid(way, speed, passes, step.time, part)
        samples += list(here + path)
        here = goals[i].copy()
        speed = np.where(passes, speed, 0.0)
        samples += [here.copy()] * step.pause
    times = np.arange(len(samples)) * UNIT
    ticks = np.arange(int(np.floor(times[-1] / robot.dt + 1e-9)) + 1) * robot.dt
    table = np.array(samples)
    return np.stack([np.interp(ticks, times, column) for column in table.T], -1)


def _trapezoid(way: Array, before: Array, passes: Array, time: int, part: int) -> tuple[Array, Array]:
    """Places `(time, n)` along `way` `(n,)` at each unit, and the speed `(n,)` a unit that a joint passes on with.

    From the speed `before` it changes to one that is kept, over `part` units, and to rest over the last `part` where it
    does not pass on: that speed is the one that covers the way in the time.
    """
    if time == 0:
        return np.zeros((0, len(way))), np.zeros_like(way)
    end: Array = np.where(passes, 0.0, float(part))
    kept = (way - before * part / 2) / np.maximum(time - part / 2 - end / 2, 1e-9)
    t = np.arange(1, time + 1)[:, None].astype(float)
    rising = np.minimum(t, part)
    path = before * rising + (kept - before) * rising**2 / (2 * max(part, 1))
    path = path + kept * np.clip(t - part, 0.0, time - part - end)
    falling = np.maximum(t - (time - end), 0.0)
    path = path + kept * (falling - falling**2 / (2 * np.maximum(end, 1.0)))
    return path, kept
