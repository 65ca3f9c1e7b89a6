"""The panels of a plot: each draws one thing about one run, or the same about several over each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy.references.gait import load_gait
from servoid.stack.log.flightlog import FlightLog
from servoid.tools.common.pictures import flightpath
from servoid.tools.common.summary import ABOUT, COURSE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROBOT, PLAN, GOAL, OBSTACLE, PUSH = "#3459b8", "#f28e1c", "#26a65b", "#8c6b51", "#c8202a"
_PHASES = ("read", "estimate", "act", "guard", "write", "record")  # of a tick


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """A figure of that size [inches], and its axes row by row. Raises ModuleNotFoundError without matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def save_figure(figure: Figure, out: Path, dpi: int = 110) -> None:
    """Write a PNG. Raises ConfigError where it cannot be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=dpi, format="png")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}): choose another place with --out") from None


@dataclass(frozen=True)
class Shown:
    """A log in a plot. One that is alone is shown in more detail than several."""

    log: FlightLog
    label: str = ""
    colour: str = ROBOT
    number: int = 0  # among so many:
    of: int = 1

    @property
    def alone(self) -> bool:
        return self.of == 1

    def seconds(self, channel: str) -> Array:
        """Time of each message since the task began (or the run, if it did not)."""
        ticks = flightpath.task_ticks(self.log)
        return (self.log.ticks(channel) - (ticks[0] if len(ticks) else 0)) / self.log.header["robot"]["rate"]

    @property
    def names(self) -> list[str]:
        """The robot's joints."""
        return [joint["name"] for joint in self.log.header["robot"]["joints"]]

    def smoothed(self, values: Array) -> tuple[Array, Array]:
        """Times [s] and means over a gait cycle of a value of each state."""
        cycle = self.log.header["task"].get("cycle") or load_gait().cycle
        ticks = max(round(cycle * self.log.header["robot"]["rate"]), 1)
        if len(values) < ticks:
            return np.zeros(0), np.zeros(0)
        first = (ticks - 1) // 2
        means = np.convolve(values, np.full(ticks, 1.0 / ticks), mode="valid")
        return self.seconds("/state")[first : first + len(means)], means


Panel = Callable[["Axes", Shown], None]


def path(axes: Axes, shown: Shown) -> None:
    log = shown.log
    ticks, first = log.ticks("/state"), flightpath.task_ticks(log)
    place = log.column("/state", "displacement")[ticks >= (first[0] if len(first) else 0)]
    if shown.alone:
        for number, plan in enumerate(flightpath.plans(log)[::8]):
            axes.plot(*plan.path.T, color=PLAN, lw=0.8, alpha=0.6, label="plans" if number == 0 else None)
    asked = flightpath.path(log)
    if asked is not None:
        moved = asked + flightpath.drift(log, -1)
        axes.plot(*moved.T, color=GOAL, lw=1.0, ls="--", label="asked")
    axes.plot(place[:, 0], place[:, 1], color=shown.colour, lw=1.6, label=shown.label or "robot")
    axes.plot(*place[:1, :2].T, "o", color=shown.colour, ms=5)
    robots = flightpath.robots(log)
    for number, other in enumerate(robots.swapaxes(0, 1) if robots is not None else ()):
        axes.plot(*other[:, :2].T, color=OBSTACLE, lw=1.2, label="others, as seen" if number == 0 else None)
        axes.plot(*other[0, :2], "o", color=OBSTACLE, ms=5)
    obstacles = flightpath.obstacles(log)
    for x, y, size in obstacles[-1] if obstacles is not None else ():
        axes.fill(*_circle(np.array([x, y]), size), color=OBSTACLE)
    for number, pose in enumerate(flightpath.keyframes(log)):
        axes.plot(*pose.place[:2], "D", mfc="none", color=GOAL, ms=5, label="keyframes" if number == 0 else None)
    _arrows(axes, log)
    goal, reach = flightpath.goal(log), flightpath.reach(log)
    if goal is not None:
        axes.plot(*goal, "*", color=GOAL, ms=14, label="goal")
        if reach is not None:
            axes.plot(*_circle(goal, reach), color=GOAL, lw=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="path from above, by the robot's estimate")
    _legend(axes)


def _arrows(axes: Axes, log: FlightLog) -> None:
    """Where and how the robot was pushed."""
    at = {int(tick): row for row, tick in enumerate(log.ticks("/state"))}
    place = log.column("/state", "displacement")
    pushed = [(place[at[tick], :2], push) for tick, push in flightpath.pushes(log).items() if tick in at]
    if pushed:
        where, change = (np.array(values) for values in zip(*pushed, strict=True))
        axes.quiver(
            *where.T, *change.T, color=PUSH, angles="xy", scale_units="xy", scale=4.0, width=0.006, label="pushes"
        )
        axes.update_datalim(where + change / 4.0)  # matplotlib leaves arrows out of what is to be seen


def velocity(axes: Axes, shown: Shown) -> None:
    log = shown.log
    seconds, measured = shown.seconds("/state"), log.column("/state", "velocity")
    ways = (("forward", ROBOT), ("left", PLAN)) if shown.alone else ((shown.label, shown.colour),)
    for column, (name, colour) in enumerate(ways):
        if shown.alone:
            axes.plot(seconds, measured[:, column], color=colour, lw=0.5, alpha=0.35)
        axes.plot(*shown.smoothed(measured[:, column]), color=colour, lw=1.4, label=name)
        _asked(axes, shown, column, colour)
    what = "velocity" if shown.alone else "velocity forward"
    raw = "thin: raw, dashed: asked" if shown.alone else "dashed: asked"
    axes.set(xlabel="s since the task began", ylabel="m/s", title=f"{what} over a gait cycle ({raw})")
    _legend(axes)


def yaw_rate(axes: Axes, shown: Shown) -> None:
    log = shown.log
    rate = -np.sum(log.column("/state", "gravity") * log.column("/state", "angular_velocity"), axis=1)
    if shown.alone:
        axes.plot(shown.seconds("/state"), rate, color=shown.colour, lw=0.5, alpha=0.35)
    axes.plot(*shown.smoothed(rate), color=shown.colour, lw=1.4, label=shown.label or None)
    _asked(axes, shown, 2, shown.colour if not shown.alone else PLAN)
    axes.set(xlabel="s since the task began", ylabel="rad/s", title="yaw rate over a gait cycle (dashed: asked)")
    _legend(axes)


def _asked(axes: Axes, shown: Shown, column: int, colour: str) -> None:
    if shown.log.messages["/instruction"]:
        asked = shown.log.column("/instruction", "velocity")[:, column]
        axes.plot(shown.seconds("/instruction"), asked, color=colour, lw=1.0, ls="--")


def tilt(axes: Axes, shown: Shown) -> None:
    """With lines at what happened, which say what it was."""
    log = shown.log
    angle = np.degrees(np.arccos(np.clip(-log.column("/state", "gravity")[:, 2], -1.0, 1.0)))
    axes.plot(shown.seconds("/state"), angle, color=shown.colour, lw=0.9, label=shown.label or None)
    happened = {  # when, what; once for what comes again and again
        ABOUT.get(event["kind"], event["kind"]): float(second)
        for event, second in zip(reversed(log.messages["/event"]), shown.seconds("/event")[::-1], strict=True)
        if event["kind"] not in COURSE
    }
    for words, second in happened.items():
        axes.axvline(second, color=PLAN, lw=0.8)
        axes.text(
            second,
            0.97,
            f" {words}",
            rotation=90,
            fontsize=7,
            ha="right",
            va="top",
            transform=axes.get_xaxis_transform(),
        )
    axes.set(xlabel="s since the task began", ylabel="degrees", title="tilt (lines: events, each kind at its first)")
    _legend(axes)


def tracking(axes: Axes, shown: Shown) -> None:
    """The error between what was commanded at a tick and where the joint was at the next."""
    names, log = shown.names, shown.log
    goal, position = log.column("/command", "position")[:-1], log.column("/observation", "position")[1:]
    rows, high = np.arange(len(names)), 0.8 / shown.of
    error = _mean((goal - position) ** 2, len(names)) ** 0.5
    axes.barh(rows + (shown.number - 0.5 * (shown.of - 1)) * high, error, high, color=shown.colour)
    axes.set_yticks(rows, names, fontsize=7)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set(xlabel="rad, root mean square", title="joint tracking error")
    axes.grid(alpha=0.3, axis="x")


def effort(axes: Axes, shown: Shown) -> None:
    _of_joints(axes, shown, np.abs(shown.log.column("/observation", "effort")), "effort", "N m", "most loaded")


def temperature(axes: Axes, shown: Shown) -> None:
    _of_joints(axes, shown, shown.log.column("/observation", "temperature"), "temperature", "degrees C", "hottest")


def _of_joints(axes: Axes, shown: Shown, values: Array, what: str, unit: str, superlative: str) -> None:
    """The four joints with the highest mean; the highest one of them alone where there are several logs."""
    seconds, mean = shown.seconds("/observation"), _mean(values, len(shown.names))
    ranked = [int(joint) for joint in np.argsort(-np.nan_to_num(mean, nan=-np.inf)) if np.isfinite(mean[joint])]
    for joint in ranked[: 4 if shown.alone else 1]:
        colour = None if shown.alone else shown.colour
        name = shown.names[joint] if shown.alone else f"{shown.label}: {shown.names[joint]}"
        known = np.isfinite(values[:, joint])
        axes.plot(seconds[known], values[known, joint], color=colour, lw=0.8, label=name)
    title = f"{what} of the four {superlative} joints" if shown.alone else f"{what} of the {superlative} joint"
    axes.set(xlabel="s since the task began", ylabel=unit, title=title)
    _legend(axes, bool(ranked))


def voltage(axes: Axes, shown: Shown) -> None:
    values, seconds = shown.log.column("/observation", "voltage"), shown.seconds("/observation")
    known = np.isfinite(values).any(axis=1) if len(values) else np.zeros(0, dtype=bool)
    if known.any():
        seconds, values = seconds[known], values[known]
        axes.plot(seconds, np.nanmedian(values, axis=1), color=shown.colour, lw=1.0, label=shown.label or "median")
        if shown.alone:
            low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
            axes.fill_between(seconds, low, high, color=shown.colour, alpha=0.25, lw=0, label="lowest to highest")
    axes.set(xlabel="s since the task began", ylabel="V", title="supply at the servos")
    axes.margins(y=0.5)
    _legend(axes, bool(known.any()))


def timing(axes: Axes, shown: Shown) -> None:
    log, seconds = shown.log, shown.seconds("/timing")
    parts = [log.column("/timing", name) * 1e-6 for name in _PHASES]
    total = np.sum(parts, axis=0)
    if shown.alone:
        axes.stackplot(seconds, parts, labels=_PHASES, lw=0)
        axes.plot(seconds, log.column("/timing", "late") * 1e-6, color="black", lw=0.6, label="late")
    else:
        axes.plot(seconds, total, color=shown.colour, lw=0.6, label=shown.label)
    if len(total):
        before = axes.get_ylim()[1] if axes.lines[1:] else 1.0
        axes.set_ylim(0.0, max(before, 1.5 * float(np.percentile(total, 99))))
    axes.set(xlabel="s since the task began", ylabel="ms", title="tick timing")
    _legend(axes, columns=4)


def joint(name: str) -> Panel:
    """A panel of a joint's target and position."""

    def draw(axes: Axes, shown: Shown) -> None:
        index, log = shown.names.index(name), shown.log
        target, position = log.column("/command", "position"), log.column("/observation", "position")
        label = shown.label or "position"
        known = np.isfinite(position[:, index])
        axes.plot(shown.seconds("/observation")[known], position[known, index], color=shown.colour, lw=1.0, label=label)
        active = np.array([message["mode"] == "ACTIVE" for message in log.messages["/command"]], dtype=bool)
        wanted = np.where(active, target[:, index], np.nan)  # nothing is asked of a joint without torque
        colour = PLAN if shown.alone else shown.colour
        again = None if axes.lines[1:] else "target"
        axes.plot(shown.seconds("/command"), wanted, color=colour, lw=0.9, ls="--", label=again)
        axes.set(xlabel="s since the task began", ylabel="rad", title=name)
        _legend(axes)

    return draw


PAGE: Sequence[Panel] = (path, velocity, yaw_rate, tilt, tracking, effort, temperature, voltage, timing)


def _mean(values: Array, columns: int) -> Array:
    """Mean of each column over what was measured; NaN where nothing was."""
    known = np.isfinite(values).reshape(-1, columns)
    count = known.sum(axis=0)
    total = np.where(known, np.reshape(values, (-1, columns)), 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _circle(middle: Array, radius: float) -> tuple[Array, Array]:
    turn = np.linspace(0.0, 2.0 * np.pi, 60)
    return middle[0] + radius * np.cos(turn), middle[1] + radius * np.sin(turn)


def _legend(axes: Axes, measured: bool = True, columns: int = 1) -> None:
    if not measured:
        axes.text(0.5, 0.5, "not measured", ha="center", va="center", transform=axes.transAxes, color="grey")
    handles = {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if handles:  # once what each of several logs has
        axes.legend(handles.values(), handles.keys(), loc="best", fontsize=7, ncols=columns)
    axes.grid(alpha=0.3)
