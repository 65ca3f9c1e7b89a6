"""Episodes of a dataset from flight logs: what `servoid collect` records of a fleet, of one robot that ran a task."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.features import raw_layout, recorded_names
from servoid.stack.log.flightlog import FlightLog
from servoid.tools.learn.dataset.schema import Feature, Schema

SHORTEST_SECONDS = 1.0  # of what is left between ticks that were missed
_NOTES = {
    "observation.state": {"meaning": "the estimate at this tick"},
    "action": {"meaning": "the joint targets that the guard sent, rad"},
    "action_applied": {"meaning": "the same: nothing was added to them"},
    "command": {"meaning": "the velocity asked for, m/s and rad/s"},
}


@dataclass(frozen=True)
class LoggedEpisode:
    """A stretch of a log's task without a missed tick."""

    log: FlightLog
    rows: Array  # (ticks,) rows of the log's states
    columns: dict[str, Array]
    tasks: tuple[str, ...]  # of each tick, what was asked for


def robot_of(log: FlightLog) -> Robot:
    """The robot of a log. Raises ConfigError where it is not the one of that name here."""
    robot = load_robot(log.header["settings"]["robot"])
    joints = tuple(joint["name"] for joint in log.header["robot"]["joints"])
    if joints != robot.names or log.header["robot"]["rate"] != robot.rate:
        raise ConfigError(f"{log.path}: was recorded with other joints or at another rate than {robot.name} has here")
    return robot


def schema_of(robot: Robot, tasks: tuple[str, ...], cameras: dict[str, tuple[int, int]]) -> Schema:
    """Columns are those of `servoid collect`, so that training reads them, and either is appended to the other."""
    features = {name: Feature(names, _NOTES[name]) for name, names in recorded_names(robot).items()}
    return Schema(robot.name, robot.rate, features, tasks, cameras)


def episodes_of(log: FlightLog, robot: Robot, task: str | None = None) -> Iterator[LoggedEpisode]:
    """The task of a log, cut where ticks were missed. `task` is what it is called where nobody asked in words.

    Raises ConfigError where there is nothing of it.
    """
    ticks = log.ticks("/instruction")
    shortest = round(SHORTEST_SECONDS * robot.rate)
    edges = np.flatnonzero(np.diff(ticks) != 1) + 1
    spans = [part for part in np.split(np.arange(len(ticks)), edges) if len(part) >= shortest]
    if not spans:
        raise ConfigError(f"{log.path}: its task did not run for {SHORTEST_SECONDS:g} s without a missed tick")
    rows = np.searchsorted(log.ticks("/state"), ticks)
    goals = log.column("/command", "position")[np.searchsorted(log.ticks("/command"), ticks)]
    fields = [log.column("/state", field)[rows] for field, _ in raw_layout(len(robot.joints)).fields]
    state = np.concatenate([values.reshape(len(ticks), -1) for values in fields], -1)
    whole = {
        "observation.state": state,
        "action": goals,
        "action_applied": goals,
        "command": log.column("/instruction", "velocity"),
    }
    texts = [_asked(message) or task or str(log.header["task"]["name"]) for message in log.messages["/instruction"]]
    for span in spans:
        columns = {name: values[span].astype(np.float32) for name, values in whole.items()}
        for name, values in columns.items():
            if not np.isfinite(values).all():
                raise ConfigError(f"{log.path}: '{name}' was not read at some ticks: it cannot be an episode")
        yield LoggedEpisode(log, rows[span], columns, tuple(texts[i] for i in span))


def _asked(message: dict[str, object]) -> str | None:
    """What a tick's instruction says in words: its text, or the skill."""
    text = message.get("text") or message.get("skill")
    return str(text) if text else None
