"""Draw a recorded run: its path from above, velocities, tilt, joint tracking and tick timing."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.pictures import flightpath
from servoid.tools.evaluate.plots import GOAL, OBSTACLE, PLAN, ROBOT

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="flight log (.mcap)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="picture to write, PNG (default: beside the log)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        log = read_log(args.log)
        out = args.out or args.log.with_suffix(".png")
        plot_run(log, out)
        if not log.complete:
            report.line(f"{args.log}: cut short; what is there was drawn")
        report.line(str(out))
        report.result({"plot": out, "complete": log.complete})
    return exit_codes.DONE


def plot_path(log: FlightLog, out: Path) -> None:
    """The path from above alone, with goal and plans. Raises ModuleNotFoundError without matplotlib."""
    figure, axes = _figure(1, 1, (6.4, 6.0))
    _path(axes, log)
    axes.set_title(title(log))
    _save(figure, out)


def plot_run(log: FlightLog, out: Path) -> None:
    """Everything on one page. Raises ConfigError for a log without states."""
    if not log.messages["/state"]:
        raise ConfigError(f"{log.path}: holds no state: the run ended before every sensor was read")
    figure, axes = _figure(2, 3, (16.0, 9.0))
    figure.suptitle(title(log))
    _path(axes[0, 0], log)
    _velocity(axes[0, 1], log)
    _tilt(axes[0, 2], log)
    _tracking(axes[1, 0], log)
    _effort(axes[1, 1], log)
    _timing(axes[1, 2], log)
    _save(figure, out)


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)


def _save(figure: Any, out: Path) -> None:
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=110, format="png")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}): choose another place with --out") from None


def title(log: FlightLog) -> str:
    """What ran, and how it ended."""
    settings, result = log.header["settings"], log.result
    end = "cut short" if result is None else result["outcome"]
    if result is not None and "seconds" in result:
        end += f" after {result['seconds']:.1f} s"
    policy = log.header["policy"]["name"]  # settings name the default where a program brought its own
    return f"{settings['task']} with {policy} on {settings['robot']}, seed {settings['seed']}: {end}"


def _seconds(log: FlightLog, channel: str) -> Array:
    """Time of each message since the task began (or the run, if it did not)."""
    ticks = flightpath.task_ticks(log)
    return (log.ticks(channel) - (ticks[0] if len(ticks) else 0)) / log.header["robot"]["rate"]


def _path(axes: Axes, log: FlightLog) -> None:
    ticks, first = log.ticks("/state"), flightpath.task_ticks(log)
    rows = ticks >= (first[0] if len(first) else 0)
    place = log.column("/state", "displacement")[rows]
    for number, plan in enumerate(flightpath.plans(log)[::8]):
        axes.plot(*plan.path.T, color=PLAN, lw=0.8, alpha=0.6, label="plans" if number == 0 else None)
    axes.plot(place[:, 0], place[:, 1], color=ROBOT, lw=1.6, label="robot")
    axes.plot(*place[0, :2], "o", color=ROBOT, ms=5)
    robots = flightpath.robots(log)
    for number, path in enumerate(robots.swapaxes(0, 1) if robots is not None else ()):
        axes.plot(*path[:, :2].T, color=OBSTACLE, lw=1.2, label="others, as seen" if number == 0 else None)
        axes.plot(*path[0, :2], "o", color=OBSTACLE, ms=5)
    obstacles = flightpath.obstacles(log)
    for x, y, size in obstacles[-1] if obstacles is not None else ():
        turn = np.linspace(0.0, 2.0 * np.pi, 40)
        axes.fill(x + size * np.cos(turn), y + size * np.sin(turn), color=OBSTACLE)
    goal = flightpath.goal(log)
    if goal is not None:
        axes.plot(*goal, "*", color=GOAL, ms=14, label="goal")
        radius = log.header["task"].get("radius", 0.1)
        turn = np.linspace(0.0, 2.0 * np.pi, 60)
        axes.plot(goal[0] + radius * np.cos(turn), goal[1] + radius * np.sin(turn), color=GOAL, lw=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="path from above, by the robot's estimate")
    axes.legend(loc="best")
    axes.grid(alpha=0.3)


def _velocity(axes: Axes, log: FlightLog) -> None:
    seconds, velocity = _seconds(log, "/state"), log.column("/state", "velocity")
    for column, (name, colour) in enumerate((("forward", ROBOT), ("left", PLAN))):
        axes.plot(seconds, velocity[:, column], color=colour, lw=0.8, label=name)
        if log.messages["/instruction"]:
            asked = log.column("/instruction", "velocity")[:, column]
            axes.plot(_seconds(log, "/instruction"), asked, color=colour, lw=1.4, ls="--")
    axes.set(xlabel="t [s]", ylabel="m/s", title="velocity of the base (dashed: asked)")
    axes.legend(loc="best")
    axes.grid(alpha=0.3)


def _tilt(axes: Axes, log: FlightLog) -> None:
    tilt = np.degrees(np.arccos(np.clip(-log.column("/state", "gravity")[:, 2], -1.0, 1.0)))
    axes.plot(_seconds(log, "/state"), tilt, color=ROBOT, lw=0.9)
    for event in log.messages["/event"]:
        if event["kind"] not in ("phase", "task"):
            start = flightpath.task_ticks(log)
            rate = log.header["robot"]["rate"]
            axes.axvline((event["tick"] - (start[0] if len(start) else 0)) / rate, color=PLAN, lw=0.8)
    axes.set(xlabel="t [s]", ylabel="degrees", title="tilt (lines: events)")
    axes.grid(alpha=0.3)


def _tracking(axes: Axes, log: FlightLog) -> None:
    """The error between what was commanded at a tick and where the joint was at the next."""
    names = [joint["name"] for joint in log.header["robot"]["joints"]]
    goal, position = log.column("/command", "position")[:-1], log.column("/observation", "position")[1:]
    error = np.sqrt(np.nanmean((goal - position) ** 2, axis=0)) if len(goal) else np.zeros(len(names))
    axes.barh(np.arange(len(names)), error, color=ROBOT)
    axes.set_yticks(np.arange(len(names)), names, fontsize=7)
    axes.invert_yaxis()
    axes.set(xlabel="rad, root mean square", title="joint tracking error")
    axes.grid(alpha=0.3, axis="x")


def _effort(axes: Axes, log: FlightLog) -> None:
    effort = np.abs(log.column("/observation", "effort"))
    names = [joint["name"] for joint in log.header["robot"]["joints"]]
    for joint in np.argsort(-np.nanmean(effort, axis=0))[:4]:
        axes.plot(_seconds(log, "/observation"), effort[:, joint], lw=0.7, label=names[joint])
    axes.set(xlabel="t [s]", ylabel="N m", title="effort of the four most loaded joints")
    axes.legend(loc="best", fontsize=7)
    axes.grid(alpha=0.3)


def _timing(axes: Axes, log: FlightLog) -> None:
    phases = ("read", "estimate", "act", "guard", "write", "record")
    seconds = _seconds(log, "/timing")
    parts = [log.column("/timing", name) * 1e-6 for name in phases]
    axes.stackplot(seconds, parts, labels=phases, lw=0)
    axes.plot(seconds, log.column("/timing", "late") * 1e-6, color="black", lw=0.6, label="late")
    total = np.sum(parts, axis=0)
    if len(total):
        axes.set_ylim(0.0, max(1.0, 1.5 * float(np.percentile(total, 99))))
    axes.set(xlabel="t [s]", ylabel="ms", title="tick timing")
    axes.legend(loc="upper right", fontsize=7, ncols=4)
    axes.grid(alpha=0.3)
