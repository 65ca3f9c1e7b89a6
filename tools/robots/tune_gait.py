"""Search for the steps that a robot walks best by, in simulation, and write them to the robot's own folder.

The search is CMA-ES over the lengths and times of the gait, each candidate walking in all directions on nominal and
randomised robots. The best so far is written whenever there is a better one, so that Ctrl-C may end the search. Where
every walk fell, nothing is written.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, check_writable, reporting

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.policy.references.gait import GaitSettings

_WALKS = np.array(  # shares of `walking.scale`, and of none and of all of the robot's twists
    [[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0], [-0.2, 0, 0], [0, 0.2, 0], [0, -0.2, 0], [0.3, 0, 0.5], [0.3, 0, -0.5]]
)
_SETTLE = 1.0  # s until the speed counts
_SIGMA = 0.3  # of CMA-ES, in steps
_SWAYING, _SHAKING, _EFFORT = 0.3, 0.02, 0.5  # weights beside the error of speed, which is a share of the top speed
# What is searched, and a step of it: lengths as shares of the leg, times of the cycle, shares of themselves, or rad.
_LENGTHS = {"height": 0.05, "foot_forward": 0.05, "foot_apart": 0.05, "lift": 0.04, "sway": 0.05, "backward_shift": 0.3}
_RATIOS = {"cycle": 0.25, "sideways_gain": 0.4, "backward_gain": 0.4, "arm_swing": 0.4, "backward_lean": 0.5}
_PLAIN = {"lean": 0.06, "double_support": 0.1, "ankle_pitch_gain": 0.04, "ankle_roll_gain": 0.04}
NAMES = (*_LENGTHS, *_RATIOS, *_PLAIN)


@dataclass(frozen=True)
class Walked:
    """How a candidate walked: its cost, the share of walks that fell, and the mean error of speed, a share of the
    robot's top speed, of those that did not."""

    cost: float
    falls: float
    error: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid tune gait`."""
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument(
        "--generations", type=int, default=40, metavar="N", help="generations of the search (default: 40)"
    )
    parser.add_argument("--candidates", type=int, default=12, metavar="N", help="gaits a generation (default: 12)")
    parser.add_argument("--seconds", type=float, default=6.0, metavar="S", help="length of a walk (default: 6)")
    parser.add_argument(
        "--randomise", type=float, default=0.3, metavar="P", help="share of walks on randomised robots (default: 0.3)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="file to write (default: gait.yaml in the robot's folder)"
    )
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Search; returns 1 where every walk fell. Raises ConfigError."""
    with reporting(args.json) as report:
        for option, least in (("generations", 1), ("candidates", 4), ("seconds", _SETTLE + 1)):
            if getattr(args, option) < least:
                raise ConfigError(f"--{option} {getattr(args, option):g}: at least {least:g}")
        try:
            import cma
        except ImportError as error:
            raise ConfigError("the search needs the package cma: pip install 'servoid[tune]'") from error
        from servoid.hw.robot.description import load_robot
        from servoid.policy.references.gait import gait_of

        robot = load_robot(args.robot)
        start = gait_of(robot)
        out = args.out or Path(robot.folder) / "gait.yaml"
        check_writable(out)
        trial = GaitTrial(robot, start, args.candidates, args.seconds, args.randomise, args.seed)
        options = {"popsize": args.candidates, "seed": args.seed + 1, "verbose": -9}
        search = cma.CMAEvolutionStrategy(np.zeros(len(NAMES)), _SIGMA, options)
        best = first = trial.walk([start] * args.candidates)[0]
        kept = start
        report.line(f"{robot.name} as it walks now: {_words(first)}")
        try:
            for generation in range(args.generations):
                points = search.ask()
                walks = trial.walk([_moved(start, point) for point in points])
                search.tell(points, [walked.cost for walked in walks])
                leader = int(np.argmin([walked.cost for walked in walks]))
                if walks[leader].cost < best.cost:
                    best, kept = walks[leader], _moved(start, points[leader])
                    _write(out, robot, kept, best)
                report.line(
                    f"{generation + 1:3d} of {args.generations}: {_words(walks[leader])}; best so far {best.cost:.3f}"
                )
        except KeyboardInterrupt:
            report.line("stopped: the best so far is kept")
        written = _write(out, robot, kept, best)
        report.line(
            f"{robot.name}: {_words(best)}; written to {out}"
            if written
            else f"{robot.name}: every walk fell; nothing is written. See servoid robot check, and "
            f"give lower speeds than {robot.walking.forward:.2f} m/s ahead as `walking` in the robot's file"
        )
        report.result(
            {"out": str(out) if written else None, "before": asdict(first), "after": asdict(best), "gait": asdict(kept)}
        )
    return exit_codes.DONE if written else exit_codes.FAILED


def _write(out: Path, robot: Robot, gait: GaitSettings, walked: Walked) -> bool:
    """Write a gait by which some walk stays up, and say whether it is one."""
    if walked.falls >= 1.0:
        return False
    out.write_text(_text(robot, gait, walked))
    return True


def _words(walked: Walked) -> str:
    return f"{100 * walked.falls:.0f} % of walks fell, speed off by {100 * walked.error:.0f} % of the top speed"


class GaitTrial:
    """Walks of a generation, all at once: each candidate under every command."""

    def __init__(
        self, robot: Robot, start: GaitSettings, candidates: int, seconds: float, randomise: float, seed: int
    ) -> None:
        from servoid.hw.robot.inverse import leg_inverse

        self._robot, self._n = robot, candidates
        self._inverse = leg_inverse(robot)
        self._commands = _WALKS * robot.walking.scale
        self._ticks = round(seconds * robot.rate)
        self._randomise, self._seed = randomise, seed

    def walk(self, gaits: Sequence[GaitSettings]) -> list[Walked]:
        """Every candidate walks with the same robots, and with the same ones in each generation."""
        from servoid.policy.references.gait import Gait, GyroFeedback
        from servoid.stack.control.fleet import Fleet

        robot, each = self._robot, len(_WALKS)
        fleet = Fleet(robot, self._n * each, None, randomise=self._randomise, seed=self._seed)
        walkers = [(Gait(robot, (each,), one, self._inverse), GyroFeedback(robot, one)) for one in gaits]
        commands = np.tile(self._commands, (self._n, 1))
        fleet.reset(np.ones(fleet.n, bool))
        alive, lasted = np.ones(fleet.n, bool), np.zeros(fleet.n)
        went, shaken, effort = np.zeros((fleet.n, 3)), np.zeros(fleet.n), np.zeros(fleet.n)
        begin = round(_SETTLE * robot.rate)
        place, heading = np.zeros((fleet.n, 2)), fleet.truth.yaw.copy()
        strength = np.array([servo.stall_torque for servo in robot.servos])
        for tick in range(self._ticks):
            state = fleet.observe()
            targets = []
            for i, (gait, feedback) in enumerate(walkers):
                rows = slice(i * each, (i + 1) * each)
                gait.command(commands[rows])
                pose = gait.pose(gait.phase, gait.velocity, gait.activity)[0]
                gait.advance()
                targets.append(feedback(pose, state.angular_velocity[rows]))
            fleet.step(np.concatenate(targets))
            truth = fleet.truth
            alive &= ~truth.fallen
            lasted += alive
            turned = (truth.yaw - heading + np.pi) % (2 * np.pi) - np.pi
            if tick >= begin:  # along the way that the body faces, and how fast it turns
                moved = (truth.position[:, :2] - place) * robot.rate
                c, s = np.cos(heading), np.sin(heading)
                ahead, aside = c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0]
                went += np.stack([ahead, aside, turned * robot.rate], -1)
                shaken += np.linalg.norm(truth.angular_velocity[:, :2], axis=-1)
                effort += (np.abs(fleet.worlds.effort) / strength).mean(-1)
            place, heading = truth.position[:, :2].copy(), truth.yaw.copy()
        counted = self._ticks - begin
        error = np.abs(went / counted - commands) / robot.walking.scale
        error = error.sum(-1).reshape(self._n, each)
        falls = 1.0 - alive.reshape(self._n, each).mean(-1)
        still = np.where(alive, 1.0 - lasted / self._ticks, 2.0 - lasted / self._ticks).reshape(self._n, each).mean(-1)
        rest = (_SHAKING * shaken + _EFFORT * effort).reshape(self._n, each).mean(-1) / counted
        cost = 3.0 * still + np.where(alive.reshape(self._n, each), error, 1.0).mean(-1) + rest
        standing = alive.reshape(self._n, each)
        mean = np.where(standing, error, 0.0).sum(-1) / np.maximum(standing.sum(-1), 1)
        return [Walked(*map(float, row)) for row in zip(cost, falls, mean, strict=True)]


def _moved(start: GaitSettings, point: Array) -> GaitSettings:
    """The gait that many steps from `start`."""
    changes: dict[str, Any] = {}
    for name, x in zip(NAMES, point.tolist(), strict=True):
        now = getattr(start, name)
        if name in _LENGTHS:
            length = 1.0 if name == "backward_shift" else start.height
            changes[name] = now + _LENGTHS[name] * length * x
        elif name in _RATIOS:
            changes[name] = now * float(np.exp(_RATIOS[name] * x))
        else:
            changes[name] = now + _PLAIN[name] * x
    changes["double_support"] = float(np.clip(changes["double_support"], 0.02, 0.6))
    changes["lift"] = max(changes["lift"], 0.02 * start.height)
    return replace(start, **changes)


def _text(robot: Robot, gait: GaitSettings, walked: Walked) -> str:
    """The gait as a file."""
    import yaml

    values = {
        name: [round(x, 5) for x in value] if isinstance(value, tuple) else round(value, 5)
        for name, value in asdict(gait).items()
    }
    head = f"# The gait of {robot.name}, by `servoid tune gait`: {_words(walked)}.\n"
    return head + yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=120)
