"""Play clips in physics: open loop, only their goals without a controller; or followed by a tracker.

The nominal robot does the same every time, so it plays once; --randomise plays on --worlds robots drawn at random. The
body error is the mean distance of the links from where the clip has them, seen from the base, until a fall. Several
clips, or none, which means the whole library, make a table.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.tools.common.confidence import wilson
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import reporting
from servoid.tools.common.parser import check_seed
from servoid.tools.motions.verbs.options import add_library_arguments, clip_of, open_library

_ROWS = ("clip", "seconds", "stands_share", "joint_error_rad", "body_error_m", "torque_p99_nm")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "clips", nargs="*", metavar="CLIP", help="name in the library, or file (default: the whole library)"
    )
    parser.add_argument("--randomise", action="store_true", help="draw each robot's mass, friction, delays and more")
    parser.add_argument("--worlds", type=int, metavar="N", help="robots to draw (default: 40)")
    parser.add_argument("--rate", type=float, default=1.0, metavar="X", help="factor on the clip's speed (default: 1)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--tracker", metavar="NAME|FILE", help="tracker that follows the clip (default: none, open loop)"
    )
    parser.add_argument(
        "--push", type=float, default=0.0, metavar="M/S", help="hardest push of the base, once a second (default: 0)"
    )
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        check_seed(args.seed)
        if args.worlds is not None and (args.worlds < 1 or not args.randomise):
            raise ConfigError(f"--worlds {args.worlds}: must be at least 1, and needs --randomise")
        worlds = (args.worlds or 40) if args.randomise else 1
        if not 0.1 <= args.rate <= 10.0:
            raise ConfigError(f"--rate {args.rate:g}: must be between 0.1 and 10")
        if not 0.0 <= args.push <= 2.0:
            raise ConfigError(f"--push {args.push:g}: must be between 0 and 2 m/s")
        if args.push and not args.tracker:
            raise ConfigError("--push: open loop nothing answers a push: give a --tracker, or drop --push")
        names = args.clips or open_library(args).names
        rows = [_play(*clip_of(name, args), worlds, args) for name in names]
        if len(args.clips) == 1:
            (result,) = rows
            report.table(("figure", "value"), [(key, _text(value)) for key, value in result.items()])
        else:
            result = {"clips": rows, "all": _all(rows)}
            shown = [*rows, {"clip": "all", **result["all"]}]
            report.table(_ROWS, [tuple(_text(row.get(key)) for key in _ROWS) for row in shown])
        report.result(result)
    return DONE


def _play(clip: Clip, robot: Robot, worlds: int, args: argparse.Namespace) -> dict[str, Any]:
    from servoid.tools.motions.bodies import body_error
    from servoid.tools.motions.physics import HOLD_SECONDS, play
    from servoid.tools.motions.tracked import follow

    clip = clip.at_rate(args.rate)
    drawn = {"worlds": worlds, "randomise": float(args.randomise), "seed": args.seed}
    if args.tracker:
        played = follow(clip, robot, args.tracker, push=args.push, **drawn)
    else:
        held = np.concatenate([clip.joints, np.repeat(clip.joints[-1:], round(HOLD_SECONDS * robot.rate), 0)])
        played = play(held, robot, begins=clip.about.begins, **drawn)
    upright = clip.about.ends == "upright"
    stood = int(played.stands.sum())
    return {
        "clip": clip.name,
        "worlds": worlds,
        "randomised": args.randomise,
        "rate": args.rate,
        "seconds": clip.ticks * robot.dt,
        "stands_share": stood / worlds if upright else None,
        "stands_ci95": wilson(stood, worlds) if upright and worlds > 1 else None,
        "joint_error_rad": float(np.sqrt(np.mean((played.joints - played.goals) ** 2))),
        "body_error_m": float(np.nanmean(body_error(played, clip, robot))),
        "torque_p99_nm": float(np.percentile(np.abs(played.effort), 99)),
        "height_at_end_m": float(played.place[:, -1, 2].mean()),
    }


def _all(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """Means over clips, of those that have a figure."""
    found: dict[str, float | None] = {}
    for key in _ROWS[1:]:
        values = [row[key] for row in rows if row[key] is not None]
        found[key] = float(np.mean(values)) if values else None
    return found


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list | tuple):
        return " to ".join(_text(item) for item in value)
    return str(value)
