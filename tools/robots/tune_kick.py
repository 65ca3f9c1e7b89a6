"""Search for a kick that is harder and stays on its feet, in simulation, and write it as a recipe of motions.

The search is CMA-ES over the joints' goals and the times of a recipe's steps, and over what hips and ankles do about a
base that tilts. Each candidate kicks a ball on nominal and randomised robots, others in each generation. The mean of
the search is written: Ctrl-C ends it and keeps that. `servoid motions author FILE` makes the clip of it, and a skill's
file takes the `balance` that is printed.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.stack.safety.balance import Balance
from servoid.tools.common.output import add_json_argument, check_writable, reporting
from servoid.tools.motions.keyframes import Authored, AuthoredClip, JointStep

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.tools.robots.kicks import Kicks

_ANGLE, _TIME, _RATE, _TILT = 0.15, 0.25, 0.03, 0.15  # a step of the search: rad, of the logarithm, s, 1
_DIAGONAL = 40  # generations in which the search learns no correlations: there are too many
_STRAIGHT = 0.15  # rad that the ball may roll to the side
_FALL, _ASIDE, _RESTLESS, _TURNED, _HURRY = 3.0, 2.0, 0.3, 0.2, 0.02  # m/s of the ball that each of these costs
_SHORTEST = 0.04  # s of a step


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid tune kick`."""
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument(
        "--recipe", default="kick", metavar="NAME|FILE", help="motion to begin with, of steps (default: kick)"
    )
    parser.add_argument("--foot", default="right", choices=("left", "right"), help="foot that kicks (default: right)")
    parser.add_argument(
        "--generations", type=int, default=150, metavar="N", help="generations of the search (default: 150)"
    )
    parser.add_argument("--candidates", type=int, default=14, metavar="N", help="kicks a generation (default: 14)")
    parser.add_argument("--worlds", type=int, default=8, metavar="N", help="robots a candidate (default: 8)")
    parser.add_argument(
        "--randomise", type=float, default=0.7, metavar="P", help="share of robots that are drawn (default: 0.7)"
    )
    parser.add_argument("--sigma", type=float, default=0.2, metavar="X", help="first step of the search (default: 0.2)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/kick.yaml"), metavar="FILE", help="recipe (default: runs/kick.yaml)"
    )
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Search; returns 0. Raises ConfigError."""
    with reporting(args.json) as report:
        for option, least in (("generations", 1), ("candidates", 4), ("worlds", 1)):
            if getattr(args, option) < least:
                raise ConfigError(f"--{option} {getattr(args, option)}: at least {least}")
        try:
            import cma
        except ImportError as error:
            raise ConfigError("the search needs the package cma: pip install 'servoid[tune]'") from error
        from servoid.hw.robot.description import load_robot
        from servoid.stack.tasks import load_task
        from servoid.tools.motions.keyframes import load_authored
        from servoid.tools.motions.stepped import stepped_goals
        from servoid.tools.robots.kicks import KickTrial

        robot, recipe = load_robot(args.robot), load_authored(args.recipe)
        if len(recipe.clips) != 1 or not recipe.clips[0].steps:
            raise ConfigError(f"--recipe {args.recipe}: must hold one clip, made of steps")
        check_writable(args.out)
        space = Space(recipe.clips[0], robot)
        ball: Any = load_task("kick", {}).settings
        trial = KickTrial(robot, args.candidates, args.worlds, ball, randomise=args.randomise, seed=args.seed)
        options = {"popsize": args.candidates, "seed": args.seed + 1, "verbose": -9, "CMA_diagonal": _DIAGONAL}
        search = cma.CMAEvolutionStrategy(np.zeros(space.size), args.sigma, options)

        def tried(points: list[Array], generation: int) -> Kicks:
            made = [space.at(point) for point in points]
            goals = [stepped_goals(clip.steps, robot) for clip in made]
            return trial.kick(goals, np.array([clip.balance.gains for clip in made]), args.foot, generation)

        try:
            for generation in range(args.generations):
                points = search.ask()
                kicks = tried(points, generation + 1)
                costs = cost(kicks)
                search.tell(points, costs.tolist())
                leader = int(costs.argmin())
                _write(args.out, recipe, space.at(search.mean), words(kicks, leader))
                report.line(f"{generation + 1:3d} of {args.generations}: {words(kicks, leader)}")
        except KeyboardInterrupt:
            report.line("stopped: what was found so far is kept")
        kicks = tried([search.mean] * args.candidates, 0)
        found = space.at(search.mean)
        _write(args.out, recipe, found, words(kicks))
        report.line(f"{words(kicks)}; written to {args.out}")
        report.line(f"its skills' files take this: balance: {_rounded(found.balance)}")
        report.line(f"next: servoid motions author {args.out} --out runs/clips")
        figures = {"ball_speed_mps": float(kicks.speed.mean()), "stands_share": float(kicks.stands.mean())}
        report.result({"out": str(args.out), **figures, "balance": _rounded(found.balance)})
    return 0


def cost(kicks: Kicks) -> Array:
    """What each candidate's kicks cost `(candidates,)`, in m/s of the ball's speed ahead."""
    ahead = kicks.speed * np.cos(kicks.angle) - _ASIDE * np.maximum(np.abs(kicks.angle) - _STRAIGHT, 0.0)
    fell = np.where(kicks.stands, 0.0, 1.5 - kicks.lasted)
    rest = _RESTLESS * np.minimum(kicks.restless, 2.0) + _TURNED * np.abs(kicks.turned) + _HURRY * kicks.hurry
    total: Array = (_FALL * fell + rest - ahead).mean(-1)
    return total


def words(kicks: Kicks, of: int | slice = slice(None)) -> str:
    """How a candidate's kicks went, or all."""
    return (
        f"ball {kicks.speed[of].mean():.2f} m/s, off by {np.abs(kicks.angle[of]).mean():.2f} rad, "
        f"{100 * kicks.stands[of].mean():.0f} % stand, turned by {np.abs(kicks.turned[of]).mean():.2f} rad"
    )


class Space:
    """Points `(size,)` of the search: changes of a clip's steps and of its balance, in steps of the search."""

    def __init__(self, clip: AuthoredClip, robot: Robot) -> None:
        self._clip = clip
        margin = robot.limits.margin
        self._ranges = {
            name: (low + margin, high - margin)
            for name, low, high in zip(robot.names, robot.lower.tolist(), robot.upper.tolist(), strict=True)
        }
        self.size = sum(len(step.joints) + 1 + (step.hold > 0.0) for step in clip.steps) + clip.balance.gains.size

    def at(self, point: Array) -> AuthoredClip:
        """The clip there, within the joints' ranges."""
        rest = iter(np.asarray(point, float).tolist())
        steps = tuple(self._step(step, rest) for step in self._clip.steps)
        gains = {
            name: (rate + _RATE * next(rest), tilt + _TILT * next(rest))
            for name, (rate, tilt) in asdict(self._clip.balance).items()
        }
        return replace(self._clip, steps=steps, balance=Balance(**gains))

    def _step(self, step: JointStep, rest: Any) -> JointStep:
        joints = {
            name: float(np.clip(angle + _ANGLE * next(rest), *self._ranges[name]))
            for name, angle in step.joints.items()
        }
        seconds = max(step.seconds * float(np.exp(_TIME * next(rest))), _SHORTEST)
        hold = step.hold * float(np.exp(_TIME * next(rest))) if step.hold > 0.0 else 0.0
        return replace(step, joints=joints, seconds=seconds, hold=hold)


def _write(path: Path, recipe: Authored, clip: AuthoredClip, how: str) -> None:
    """The recipe with this clip, as a file."""
    import yaml

    about = {key: value for key, value in asdict(clip).items() if value and key not in ("frames", "steps", "balance")}
    about = {key: value for key, value in about.items() if key not in ("begins", "ends")}  # it begins and ends upright
    about["captions"] = list(clip.captions)
    steps = []
    for step in clip.steps:
        row: dict[str, Any] = {"seconds": round(step.seconds, 4)}
        row |= {"hold": round(step.hold, 4)} if step.hold else {}
        row |= {"home": True} if step.home else {}
        row |= {"joints": {name: round(angle, 4) for name, angle in step.joints.items()}} if step.joints else {}
        steps.append(row)
    made = {**about, "balance": _rounded(clip.balance), "steps": steps}
    head = f"# By `servoid tune kick`: {how}.\n"
    body = {"licence": recipe.licence, "clips": [made]}
    path.write_text(head + yaml.safe_dump(body, sort_keys=False, default_flow_style=None, width=120))


def _rounded(balance: Balance) -> dict[str, list[float]]:
    return {name: [round(gain, 3) for gain in gains] for name, gains in asdict(balance).items()}
