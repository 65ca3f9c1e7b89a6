"""Identify servos of virtual rigs whose figures are hidden from the fit, and compare what it finds with them.

Each rig's servos are drawn anew: stiffness, friction, damping, armature, delay, stall torque and no-load speed, with or
without Stribeck's and load friction, and the supply's resistance. The robot's own file is all that the fit knows. A
rig takes about a minute of one core.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot, Servo, load_robot, save_servo
from servoid.tools.common.output import add_json_argument, reporting

if TYPE_CHECKING:
    from servoid.tools.identify.fit import Fit
    from servoid.tools.identify.recording import Piece

GAINS = (1.0, 0.5)
_WITHIN, _FOLLOWS = 0.05, 0.3  # of the figure; degrees RMS
_COMPARED = ("stiffness", "friction", "command_delay")  # what must be found within that
_STEP = 0.004  # s: a rig's delays are whole steps of its physics


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid bench identify`."""
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--rigs", type=int, default=3, metavar="N", help="rigs with hidden servos (default: 3)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the first rig (default: 0)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Identify all rigs; returns 0. Raises ConfigError."""
    with reporting(args.json) as report:
        if args.rigs < 1:
            raise ConfigError(f"--rigs {args.rigs}: at least 1")
        robot, rows, results = load_robot(args.robot), [], []
        for seed in range(args.seed, args.seed + args.rigs):
            began = time.monotonic()
            with tempfile.TemporaryDirectory(prefix="servoid-identify-") as folder:
                rig = hidden(robot, seed, Path(folder))
                fit, _ = identify_rig(robot, rig, Path(folder))
                result = compared(fit, robot, rig) | {"seed": seed, "seconds": time.monotonic() - began}
            results.append(result)
            errors = [f"{100 * result['errors'][name]:+.1f} %" for name in _COMPARED]
            good = "yes" if result["good"] else "NO"
            rows.append(
                (seed, *errors, f"{result['held_out_degrees']:.3f}", fit.model, f"{result['seconds']:.0f} s", good)
            )
            report.line(f"rig {seed}: {', '.join(errors)}; {result['held_out_degrees']:.3f} degrees")
        heads = ("stiffness", "friction", "delay")
        report.table(("rig", *heads, "held out, degrees", "friction model", "took", "as asked"), rows)
        good = sum(result["good"] for result in results)
        report.line(
            f"{good} of {len(results)} rigs: each of these within {100 * _WITHIN:.0f} %, and simulation within "
            f"{_FOLLOWS:g} degrees RMS of the rig on motions that it was not fitted on"
        )
        report.result({"rigs": results, "good": good})
    return 0


def hidden(robot: Robot, seed: int, folder: Path) -> Robot:
    """The robot with other servos, whose files are put into `folder`: each model's figures drawn anew."""
    rng = np.random.default_rng(seed)
    models = {joint.servo: servo for joint, servo in zip(robot.joints, robot.bare_servos, strict=True)}
    for servo in models.values():
        save_servo(_drawn(rng, servo), folder / f"{servo.name}.yaml")
    joints = tuple(replace(joint, servo=str(folder / f"{models[joint.servo].name}.yaml")) for joint in robot.joints)
    bus = replace(robot.bus, supply_resistance=float(rng.uniform(0.02, 0.08)))
    return replace(robot, joints=joints, bus=bus)


def _drawn(rng: np.random.Generator, servo: Servo) -> Servo:
    """A servo of the same kind and another unit: within what the randomised robot of training is drawn from."""

    def factor(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    friction = servo.friction * factor(0.5, 2.0)
    stribeck, loaded = rng.random(2) < 0.5
    return replace(
        servo,
        stiffness=servo.stiffness * factor(0.6, 1.8),
        friction=friction,
        damping=servo.damping * factor(0.5, 2.0),
        armature=servo.armature * factor(0.5, 2.0),
        stall_torque=servo.stall_torque * factor(0.85, 1.2),
        no_load_speed=servo.no_load_speed * factor(0.9, 1.1),
        command_delay=_STEP * int(rng.integers(2, 11)),
        stribeck_friction=friction * float(rng.uniform(0.2, 0.6)) if stribeck else 0.0,
        stribeck_speed=float(rng.uniform(0.08, 0.25)),
        load_friction=float(rng.uniform(0.05, 0.15)) if loaded else 0.0,
    )


def identify_rig(
    robot: Robot, rig: Robot, folder: Path, joints: tuple[str, ...] | None = None
) -> tuple[Fit, list[Piece]]:
    """Record on a virtual rig in this process and fit, knowing the robot's file alone."""
    from servoid.tools.identify.fit import identify
    from servoid.tools.identify.recording import read_pieces

    pieces = read_pieces(record_rig(robot, rig, folder, joints), robot)
    fit, _ = identify(robot, pieces, lambda text: None)
    return fit, pieces


def record_rig(robot: Robot, rig: Robot, folder: Path, joints: tuple[str, ...] | None = None) -> list[Path]:
    """The logs of a virtual rig in this process, on its gantry."""
    from servoid.sim.rig.in_process import InProcessBackend
    from servoid.sim.rig.rig import Rig
    from servoid.tools.identify.excitation import plan
    from servoid.tools.identify.session import record

    motions = plan(robot, [joints or robot.names])
    body = InProcessBackend(Rig(rig))
    body.rig.auto_release = False
    logs = []
    try:
        handles = body.connect()
        for gain in GAINS:
            recorded = record(body, handles, robot, motions, gain, folder / f"gain-{gain:g}.mcap")
            if recorded.cause != "task":
                raise ConfigError(f"the rig's recording ended early: {'; '.join(recorded.texts)}")
            logs.append(recorded.log)
    finally:
        body.close()
    return logs


def compared(fit: Fit, robot: Robot, rig: Robot) -> dict[str, Any]:
    """What was found against what was hidden: the largest error of any of the robot's servos, as a share."""
    truth = {own.name: other for own, other in zip(robot.bare_servos, rig.bare_servos, strict=True)}
    errors: dict[str, float] = {}
    for name, servo in fit.servos.items():
        for figure in _COMPARED:
            off = getattr(servo, figure) / getattr(truth[name], figure) - 1.0
            if abs(off) >= abs(errors.get(figure, 0.0)):
                errors[figure] = off
    held_out = math.degrees(fit.held_out)
    good = all(abs(error) <= _WITHIN for error in errors.values()) and held_out <= _FOLLOWS
    return {"errors": errors, "held_out_degrees": held_out, "model": fit.model, "good": good}
