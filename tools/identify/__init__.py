"""Measure what a robot's servos are like, and write their files.

The robot hangs from a gantry, its base held still and its limbs free. Torque comes on at every joint, each where it is;
then joints move by up to 0.3 rad about the home pose, in steps, slow ramps and swings, at two gains, for about a
minute, through the guard. Stiffness, friction, armature, delay and the rest are then fitted until a simulated robot
moves as the real one did, and judged by a motion that nothing was fitted on. Figures that the motions do not determine
are named. Everything is recorded: after an interruption, or to fit again, give the logs to --from.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError, nearest
from servoid.hw.robot.description import Payload, Robot
from servoid.tools.bringup.line import add_line_arguments, assembled, is_virtual
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, check_writable, reporting
from servoid.tools.identify.figures import MODELS

if TYPE_CHECKING:
    from servoid.tools.identify.excitation import Exercise

_GAINS = (1.0, 0.5)
_AMPLITUDES = (0.05, 0.6)  # rad


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid identify`."""
    add_line_arguments(parser)
    parser.add_argument(
        "--from", dest="logs", nargs="+", type=Path, metavar="LOG", help="fit recordings; nothing moves"
    )
    parser.add_argument("--joints", nargs="+", metavar="JOINT", help="joints that move (default: all)")
    parser.add_argument("--one-by-one", action="store_true", help="one joint at a time, instead of all at once")
    parser.add_argument("--amplitude", type=float, default=0.3, metavar="RAD", help="of the motions (default: 0.3)")
    parser.add_argument(
        "--load", action="append", default=[], metavar="BODY=KG[@X,Y,Z]",
        help="a known weight on a body of the model, at a point of its frame [m]; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="folder of logs, servo files and picture (default: identified/ROBOT)"
    )
    parser.add_argument(
        "--friction", choices=list(MODELS), metavar="MODEL",
        help=f"model of friction: {', '.join(MODELS)} (default: what predicts motions best that it was not fitted on)",
    )  # fmt: skip
    parser.add_argument("--start", action="store_true", help="switch torque on without asking")


def main(args: argparse.Namespace) -> int:
    """Record and fit; returns 0, or the exit code of a recording that did not come to its end."""
    with reporting(args.json) as report:
        try:
            import cma  # noqa: F401  # before anything moves
        except ImportError as error:
            raise ConfigError("the fit needs the package cma: pip install 'servoid[tune]'") from error
        if args.logs is None:
            robot, groups = _checked(args, report)
        else:
            robot, groups = _unmoved(args), []
        out: Path = args.out or Path("identified") / robot.name
        check_writable(out / "identified.png")
        logs = args.logs or _record(args, robot, groups, out, report)
        if isinstance(logs, int):
            return logs
        report.result(_fit(robot, logs, out, report, MODELS if args.friction is None else (args.friction,)))
    return exit_codes.DONE


def _unmoved(args: argparse.Namespace) -> Robot:
    """The robot of recordings. Raises ConfigError for options that only a recording takes."""
    from servoid.hw.robot.description import load_robot

    others = {"--port": args.port, "--joints": args.joints, "--load": args.load, "--one-by-one": args.one_by_one}
    if given := [name for name, value in others.items() if value]:
        raise ConfigError(f"--from fits what was recorded, and {given[0]} is for recording: drop one of them")
    return load_robot(args.robot)


def _checked(args: argparse.Namespace, report: Report) -> tuple[Robot, list[Sequence[str]]]:
    """The robot with its loads, and the groups of joints that move together. Raises ConfigError."""
    low, high = _AMPLITUDES
    if not low <= args.amplitude <= high:
        raise ConfigError(f"--amplitude {args.amplitude:g}: must be between {low:g} and {high:g} rad")
    robot = assembled(args, report)
    for name in args.joints or ():
        if name not in robot.names:
            raise ConfigError(f"{robot.name} has no joint '{name}'; {nearest(name, robot.names)}")
    names = tuple(name for name in robot.names if args.joints is None or name in args.joints)
    loads = dict(robot.loads) | dict(_load(text) for text in args.load)
    groups: list[Sequence[str]] = [[name] for name in names] if args.one_by_one else [names]
    return replace(robot, loads=loads), groups


def _load(text: str) -> tuple[str, Payload]:
    body, _, rest = text.partition("=")
    mass, _, at = rest.partition("@")
    try:
        place = [float(part) for part in at.split(",")] if at else [0.0, 0.0, 0.0]
        x, y, z = place
        load = Payload(float(mass), (x, y, z))
    except ValueError:
        raise ConfigError(f"--load {text}: write BODY=KG or BODY=KG@X,Y,Z, such as l_foot=0.2@0.02,0,-0.03") from None
    if not 0.0 < load.mass < 100.0:
        raise ConfigError(f"--load {text}: a weight must be between 0 and 100 kg")
    return body, load


def _record(
    args: argparse.Namespace, robot: Robot, groups: list[Sequence[str]], out: Path, report: Report
) -> list[Path] | int:
    """The logs of the motions at each gain, or the exit code where one did not come to its end."""
    from servoid.stack.log.recorder import check_new, free_name
    from servoid.stack.runtime.backends import make_backend
    from servoid.tools.common.prompt import confirm
    from servoid.tools.identify.excitation import plan
    from servoid.tools.identify.session import record

    motions = plan(robot, groups, args.amplitude)
    _announce(report, robot, motions, args)
    virtual = is_virtual(args)
    logs: list[Path] = []
    with ExitStack() as stack:
        check_new(free_name("identify", out))
        body = make_backend(
            "virtual" if virtual else "dynamixel", robot, seed=0, randomise=False, port=None if virtual else args.port
        )
        stack.callback(body.close)
        handles = body.connect()
        if virtual:
            body.rig.control.hold()  # type: ignore[attr-defined]  # on its gantry
        elif not args.start:
            confirm("Hang the robot up, limbs free", "give --start to switch torque on without being asked")
        for gain in _GAINS:
            recorded = record(body, handles, robot, motions, gain, free_name("identify", out))
            logs.append(recorded.log)
            for text in recorded.texts:
                report.line(text)
            if recorded.cause != "task":
                kept = " ".join(str(log) for log in logs)
                report.line(
                    f"Torque is off. What was recorded is kept: servoid identify --robot {args.robot} --from {kept}"
                )
                report.result({"cause": recorded.cause, "logs": [str(log) for log in logs]})
                return exit_codes.INTERRUPTED if recorded.cause == "interrupt" else exit_codes.STOPPED
            report.line(f"gain {gain:g}: recorded to {recorded.log}; torque is off")
    return logs


def _announce(report: Report, robot: Robot, motions: Sequence[Exercise], args: argparse.Namespace) -> None:
    seconds = len(_GAINS) * sum(len(motion.goals) for motion in motions) * robot.dt
    moving = ", ".join(args.joints) if args.joints else f"all {len(robot.joints)} joints"
    how = "one after the other" if args.one_by_one else "at once"
    report.line(
        f"{moving} of {robot.name} will move {how}, by up to {args.amplitude:g} rad about the home pose, at up to "
        f"{robot.limits.joint_speed:g} rad/s, for {seconds:.0f} s in all. Hold its base, and let its limbs hang "
        "free. Ctrl-C: torque off."
    )
    for body, load in robot.loads.items():
        report.line(f"On {body} hang {load.mass:g} kg.")


def _fit(robot: Robot, logs: Sequence[Path], out: Path, report: Report, models: Iterable[str]) -> dict[str, Any]:
    """Fit, tell, write the servos' files and draw. Returns the result."""
    import math

    from servoid.tools.identify.fit import identify
    from servoid.tools.identify.outcome import announce, write
    from servoid.tools.identify.recording import read_pieces

    pieces = read_pieces(logs, robot)
    report.line(f"fitting {len(pieces)} motions; Ctrl-C loses nothing: fit again with --from")
    best, fits = identify(robot, pieces, report.line, tuple(models))
    announce(best, report)
    files = write(best, pieces, out, report)
    return {
        "model": best.model,
        "held_out_degrees": math.degrees(best.held_out),
        "error_degrees": math.degrees(best.error),
        "models": {fit.model: math.degrees(fit.held_out) for fit in fits},
        "figures": [
            {"servo": f.figure.servo, "name": f.figure.name, "value": f.value, "spread": f.spread}
            | {"determined": f.determined}
            for f in best.found
        ],
        "servos": {name: asdict(servo) for name, servo in best.servos.items()},
        "files": [str(path) for path in files],
        "logs": [str(log) for log in logs],
    }
