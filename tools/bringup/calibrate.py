"""Measure how each servo sits in its joint: zero and direction.

Torque is off: you put the robot into its reference pose by hand, then turn one joint after another. The result is kept
in your configuration folder and used by every command that drives the robot. Nothing is written to a servo.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array, BackendError
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.bringup.line import Line, add_line_arguments, is_virtual, open_line
from servoid.tools.bringup.session import at_desk
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report
from servoid.tools.web.launch import add_view_arguments

if TYPE_CHECKING:
    from servoid.hw.dynamixel.calibration import Calibration, JointCalibration
    from servoid.hw.dynamixel.servos.register_check import Found
    from servoid.tools.bringup.calibration.encoders import Encoders
    from servoid.tools.bringup.calibration.hands import Hands

MOVED = 0.15  # rad that a joint has to be turned by
BEYOND = 0.1  # rad beyond its range at which a joint cannot be
FAR = 0.5  # rad between a zero and the file's that a person should look at
PATIENCE = 120.0  # s for each thing that a person does
_OTHER_SECONDS = 4.0  # for which another joint may be off before it is taken for a mistake


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    add_view_arguments(parser)
    parser.add_argument(
        "--pose", choices=("zero", "home"), default="zero", help="reference pose: all joints at 0 (default), or home"
    )
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="JOINT",
        help="only this joint, of a calibrated robot; may be repeated",
    )
    parser.add_argument(
        "--keep-directions",
        action="store_true",
        help="measure only zeros; directions come from the earlier calibration, or from the robot's file",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="file to write (default: in your configuration folder)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="random seed of the virtual rig's assembly (default: 0)"
    )
    parser.add_argument("--yes", action="store_true", help="write without asking")


def main(args: argparse.Namespace) -> int:
    return at_desk(args, "calibrate", work)


def work(args: argparse.Namespace, desk: Desk) -> int:
    """Do it, together with the person at the desk."""
    from servoid.hw.dynamixel.calibration import apply, calibration_path, check_writable

    report, robot = desk.report, load_robot(args.robot)
    if geared := [joint.name for joint in robot.joints if joint.gear != 1.0]:
        raise ConfigError(
            f"{', '.join(geared)}: behind a gear, a servo's angle does not say which turn the joint is in: measure "
            "their zeros yourself, and write them into the robot's file"
        )
    virtual = is_virtual(args)
    path = args.out or (None if virtual else calibration_path(robot))
    chosen = _chosen(args.joint, robot)
    earlier = _earlier(path, robot, chosen, args.keep_directions)
    if path is not None:
        check_writable(path)
    reference = _reference(args.pose, robot)
    factory_state = None
    if virtual:
        from servoid.sim.rig.servo.factory_state import FactoryState

        factory_state = FactoryState(assembly="random")
    with open_line(args, robot, factory_state=factory_state, seed=args.seed) as line:
        zeros, directions = _measure(line, robot, reference, chosen, earlier, args, desk)
    result = _calibration(robot, zeros, directions, chosen, earlier, args.pose)
    _show(robot, result, report)
    apply(robot, result, "what was measured")  # refuses what no servo could be driven with
    if path is None:
        report.line("not kept: a virtual rig of its own is gone now; --out FILE keeps it")
    else:
        if not args.yes:
            kept_text = ", and the earlier one kept beside it" if path.exists() else ""
            desk.confirm(f"{path} will be written{kept_text}: whatever drives {robot.name} will use it")
        kept = keep(result, path)
        report.line(f"written to {path}" + (f"; the earlier one is {kept}" if kept else ""))
        report.line("next: servoid bringup check --fix, which sets the servos' own limits to match")
    report.result({"path": path, **asdict(result)})
    return exit_codes.DONE


def _measure(
    line: Line,
    robot: Robot,
    reference: Array,
    chosen: list[int],
    earlier: Mapping[str, JointCalibration],
    args: argparse.Namespace,
    desk: Desk,
) -> tuple[Array, Array]:
    """Zeros [rad] and directions `(n_joints,)`."""
    import numpy as np

    from servoid.hw.dynamixel.servos.bus_scan import BAUDS
    from servoid.hw.dynamixel.servos.register_check import find_servos
    from servoid.hw.dynamixel.transport.bus import LONGEST_RETURN_DELAY
    from servoid.tools.bringup.calibration.encoders import Encoders, short
    from servoid.tools.bringup.calibration.hands import Person, VirtualHands
    from servoid.tools.bringup.scan import powered

    powered(line.bus, robot, BAUDS)
    if line.bus.port.baud != robot.bus.baud:
        line.bus.set_baud(robot.bus.baud)
    line.bus.return_delay = LONGEST_RETURN_DELAY  # until the servos' own is known
    found = find_servos(line.bus, robot)
    refuse(found)
    # Shown by the robot's file until the reference pose is known.
    directions = np.array([earlier.get(joint.name, joint).direction for joint in robot.joints])
    zeros = np.array([earlier.get(joint.name, joint).zero for joint in robot.joints])
    encoders = Encoders(
        line.bus, line.clock, robot, found, lambda angles: desk.show_limp(zeros + directions * angles, reference)
    )
    hands: Hands = Person(desk) if line.control is None else VirtualHands(line.control, robot, desk.report)
    angles = dict(zip(robot.names, reference.tolist(), strict=True))
    where = "every joint at 0" if args.pose == "zero" else "its home pose, standing"
    hands.pose(angles, f"{robot.name} is limp. Put it into its reference pose, {where}, and hold it still")
    at_reference = encoders.still(PATIENCE)
    zeros = short(reference - directions * at_reference)
    if not args.keep_directions:
        for i, sign in directions_of(encoders, hands, robot, reference, chosen).items():
            directions[i] = sign
            zeros = short(reference - directions * at_reference)
    return short(reference - directions * at_reference), directions


def refuse(found: list[Found]) -> None:
    """Raise BackendError for servos that cannot be measured: with torque, or with registers that bend angles."""
    if stiff := [servo.joint.name for servo in found if servo.get("torque_enable")]:
        raise BackendError(
            f"{', '.join(stiff)} has torque on: end the program that drives it, hold it, then servoid bringup off"
        )
    for register in ("homing_offset", "drive_mode"):
        if bent := [servo.joint.name for servo in found if servo.get(register)]:
            raise BackendError(
                f"{', '.join(bent)} has a {register} that is not 0, which would bend what is measured: "
                "servoid bringup check --fix first"
            )


def directions_of(
    encoders: Encoders, hands: Hands, robot: Robot, reference: Array, chosen: list[int]
) -> dict[int, int]:
    """Direction of each chosen joint, by number, from turns by hand, each away from the nearer end of its range."""
    import numpy as np

    from servoid.tools.bringup.calibration.turning import describe_turns

    signs = np.where(robot.upper - reference >= reference - robot.lower, 1, -1)
    texts = describe_turns(robot, reference, signs)
    found = {}
    for count, i in enumerate(chosen, start=1):
        text = f"[{count}/{len(chosen)}] turn {robot.names[i]} by some 20 degrees, so that {texts[i]}; hold it there"
        angle = None
        while angle is None:
            start = encoders.still(PATIENCE)
            hands.turn(robot.names[i], int(signs[i]), text)
            angle = turned(encoders, start, i, robot)
            text = f"      it did not stay there: turn {robot.names[i]} again, so that {texts[i]}; hold it there"
        check_range(robot, i, float(reference[i]) + int(signs[i]) * abs(angle))
        hands.back(robot.names[i])
        found[i] = int(signs[i]) * (1 if angle > 0.0 else -1)
    return found


def turned(encoders: Encoders, start: Array, i: int, robot: Robot) -> float | None:
    """Wait until joint `i` was turned from `start` and rests; by how much [rad] its servo turned. None when it was not
    held there: of a joint that was put straight back, noise would tell the direction.

    Raises BackendError when another joint was, which is how swapped IDs show.
    """
    import numpy as np

    from servoid.tools.bringup.calibration.encoders import PERIOD_NS, short

    ticks, others = round(PATIENCE * 1e9 / PERIOD_NS), 0
    for _ in range(ticks):
        moved = short(encoders.read() - start)
        if abs(moved[i]) >= MOVED:
            angle = float(short(encoders.still(PATIENCE) - start)[i])
            return angle if angle * moved[i] > 0.0 and abs(angle) >= MOVED / 2 else None
        other = int(np.abs(moved).argmax())
        others = others + 1 if abs(moved[other]) >= MOVED and abs(moved[i]) < MOVED / 4 else 0
        if others * PERIOD_NS >= _OTHER_SECONDS * 1e9:
            a, b = robot.joints[i], robot.joints[other]
            raise BackendError(
                f"{b.name} (ID {b.id}) turned, not {a.name} (ID {a.id}): begin again; if it was {a.name} that you "
                "turned, the two servos have each other's ID: servoid bringup setup"
            )
    raise BackendError(f"{robot.names[i]} was not turned within {PATIENCE:g} s: begin again")


def check_range(robot: Robot, i: int, position: float) -> None:
    """Raise BackendError when joint `i` was turned to where it cannot be."""
    joint = robot.joints[i]
    low, high = joint.range
    if not low - BEYOND <= position <= high + BEYOND:
        raise BackendError(
            f"{joint.name} would be at {position:.2f} rad now, beyond its range {low:g} to {high:g}: it was turned the "
            "wrong way, or did not begin in the reference pose; begin again"
        )


def _reference(pose: str, robot: Robot) -> Array:
    import numpy as np

    if pose == "home":
        return robot.home
    if outside := [joint.name for joint in robot.joints if not joint.range[0] <= 0.0 <= joint.range[1]]:
        raise ConfigError(f"{', '.join(outside)} cannot be at 0: use --pose home")
    return np.zeros(len(robot.joints))


def _chosen(names: list[str], robot: Robot) -> list[int]:
    for name in names:
        if name not in robot.names:
            raise ConfigError(f"{robot.name} has no joint '{name}'; {nearest(name, robot.names)}")
    return [i for i, name in enumerate(robot.names) if not names or name in names]


def keep(result: Calibration, path: Path) -> Path | None:
    """Save what was measured; where that fails after all, keep it where temporary files are, and say where.

    Returns the earlier one's new name. Raises ConfigError.
    """
    from servoid.hw.dynamixel.calibration import as_text, save_calibration

    try:
        return save_calibration(result, path)
    except ConfigError as error:
        text = as_text(result)
        try:
            with NamedTemporaryFile("w", prefix="servoid-calibration-", suffix=".yaml", delete=False) as file:
                file.write(text)
        except OSError:
            error.add_note(text)  # printed: the last that is left
            raise error from None
        raise ConfigError(f"{error}; what was measured is kept in {file.name}: copy it to {path}") from error


def _earlier(path: Path | None, robot: Robot, chosen: list[int], keep: bool) -> Mapping[str, JointCalibration]:
    """What was measured before, by joint: of those that are not measured now and, to `keep` directions, of all.

    Read before anybody moves anything. Raises ConfigError where a joint that is needed was never measured: what the
    robot's file says of it must not be written down as measured.
    """
    whole = len(chosen) == len(robot.joints)
    if path is None or (whole and not (keep and path.exists())):
        return {}
    from servoid.hw.dynamixel.calibration import load_calibration

    if not path.exists():
        raise ConfigError(f"{path}: no such calibration yet: calibrate all joints first, without --joint")
    earlier = load_calibration(path).joints
    if lacking := [name for i, name in enumerate(robot.names) if name not in earlier and (keep or i not in chosen)]:
        raise ConfigError(
            f"{path}: nothing about {lacking[0]}: calibrate all joints first, without --joint and --keep-directions"
        )
    return earlier


def _calibration(
    robot: Robot,
    zeros: Array,
    directions: Array,
    chosen: list[int],
    earlier: Mapping[str, JointCalibration],
    pose: str,
) -> Calibration:
    from servoid.hw.dynamixel.calibration import Calibration, JointCalibration

    joints = {}
    for i, (joint, servo) in enumerate(zip(robot.joints, robot.servos, strict=True)):
        measured = JointCalibration(joint.id, servo.name, int(directions[i]), round(float(zeros[i]), 5))
        described = JointCalibration(joint.id, servo.name, joint.direction, joint.zero)  # which is not kept anywhere
        joints[joint.name] = measured if i in chosen else earlier.get(joint.name, described)
    return Calibration(robot.name, datetime.now().astimezone().isoformat(timespec="seconds"), pose, joints)


def _show(robot: Robot, result: Calibration, report: Report) -> None:
    rows = []
    for joint in robot.joints:
        measured = result.joints[joint.name]
        remarks = ["the other way round"] if measured.direction != joint.direction else []
        remarks += (
            ["far from the file's: was this the reference pose?"] if abs(measured.zero - joint.zero) > FAR else []
        )
        rows.append((joint.name, joint.id, f"{measured.direction:+d}", f"{measured.zero:+.4f}", "; ".join(remarks)))
    report.line()
    report.table(("joint", "ID", "direction", "zero [rad]", ""), rows)
