"""What a row of a table is: runs of a task by a policy, a measure of each, and the figures to hold it against."""

from __future__ import annotations

import difflib
import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from servoid.hw.config import ConfigError
from servoid.tools.commands.rollout import ENDED


@dataclass(frozen=True)
class Network:
    """A network that is not shipped. `train` are the options of `servoid train diffusion` beside --data and --out.

    With `latents` it plans latents, which `servoid train latent` makes first.
    """

    name: str
    train: str
    latents: bool = False


@dataclass(frozen=True)
class Run:
    """Episodes of a task. Rows with the same run measure the same episodes.

    `plan` overrides settings of the diffusion policy, as `set` those of the task: text, as typed on a command line.
    """

    task: str
    set: Mapping[str, str] = field(default_factory=dict)
    plan: Mapping[str, str] = field(default_factory=dict)
    policy: Literal["planner", "expert"] = "planner"
    backend: str = "sim"
    randomise: bool = False
    episodes: int = 100
    quick_seconds: float | None = None  # at most so long an episode with --quick
    clips: int = 0  # recorded motions of the expert that the task takes its keyframes from
    network: Network | None = None  # instead of the evaluated one


@dataclass(frozen=True)
class Metric:
    """A figure of each episode, `of` naming it in the episode's record with dots; the row's value is their mean."""

    of: str
    unit: str = ""
    share: bool = False  # true or false, instead of a number
    cut_short: bool = False  # of a share: true as well where the guard broke the run off, or it never began
    lower: bool = False  # whether less is better
    # How an episode counts that fell or was stopped: until then, with what it left undone, or (like all that did not
    # succeed) not at all.
    unfinished: Literal["until then", "whole", "left out"] = "until then"
    resolution: float = 0.0  # of the unit: what is finer is rounding of the simulation, and nothing to compare

    def values(self, records: Sequence[Mapping[str, Any]]) -> list[float]:
        """The figure of each episode that has it."""
        values = [True if self.cut_short and cut_short(record) else _pick(record, self.of) for record in records]
        finite = [float(value) for value in values if value is not None and math.isfinite(value)]
        return [round(value / self.resolution) * self.resolution for value in finite] if self.resolution else finite


@dataclass(frozen=True)
class Beside:
    """A figure to reach that is so many times the value of another row."""

    row: str
    factor: float


@dataclass(frozen=True)
class Row:
    """A row: `published` is in the paper's own unit, `figure`, the one to reach, in the metric's."""

    name: str
    paper: str
    title: str
    run: Run
    metric: Metric
    published: float | None = None
    published_unit: str | None = None  # where it is not the metric's
    figure: float | Beside | None = None
    quick: bool = True  # whether --quick measures it
    note: str = ""


def cut_short(record: Mapping[str, Any]) -> bool:
    """Whether an episode ended by a fall, by the guard, or before it began, and not as its task ends."""
    return bool(record.get("fell")) or record.get("outcome") not in ENDED


def _pick(record: Mapping[str, Any], path: str) -> float | None:
    value: Any = record
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def select(rows: Sequence[Row], patterns: Sequence[str], quick: bool) -> list[Row]:
    """The rows that match a pattern such as `uniphys/goal-*`, without patterns all of them or those that are quick.

    Rows that a figure to reach is taken from come along. Raises ConfigError for a pattern that matches none.
    """
    names = [row.name for row in rows]
    chosen = {row.name for row in rows if not patterns and (row.quick or not quick)}
    for pattern in patterns:
        matching = fnmatch.filter(names, pattern)
        if not matching:
            close = difflib.get_close_matches(pattern, names, n=1)
            hint = f"did you mean '{close[0]}'?" if close else f"there are {', '.join(names)}"
            raise ConfigError(f"--rows {pattern}: no such row; {hint}")
        chosen.update(matching)
    chosen.update(row.figure.row for row in rows if row.name in chosen and isinstance(row.figure, Beside))
    return [row for row in rows if row.name in chosen]
