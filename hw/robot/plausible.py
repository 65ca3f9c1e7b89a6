"""Limits that a robot's servos, its legs and its bus allow. Each failure names the file, the line and the key.

A number may be of the right kind and sign and yet one that nobody can have meant: degrees for radians, a speed that no
servo reaches, a supply at which its servos are off, a control cycle that takes longer than a tick.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servoid.hw.config import Marks

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot

HOMING_SHARE = 0.25  # of the servos' no-load speed: homing begins in any pose, and a person must be able to stop it
GRAVITY = 9.81
BUS_SHARE = 0.8  # of a tick: what is left is for a second request and for deciding
BAUDS = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
BITS = 10  # of a byte on the wire
WRITE, ANSWER, REQUEST = 14, 11, 14  # bytes of a sync write, of an answer and of a sync read, besides what they carry
PRESENT, GOAL, BOARD, WATCHED, MEASURED = 10, 4, 20, 35, 3  # bytes of each servo or of the board
LOOKED_AT = 4  # servos whose other registers are read in a tick


def check_plausible(robot: Robot, marks: Marks) -> None:
    """Raise ConfigError for the first limit that cannot be meant."""
    _check_bus(robot, marks)
    _check_speeds(robot, marks)
    _check_protections(robot, marks)
    _check_angles(robot, marks)


def cycle_seconds(servos: int, baud: int, *, board: bool = True, return_delay: float = 0.0) -> float:
    """What the reads and writes of a tick take on the wire [s], by ordinary sync reads."""
    some = min(LOOKED_AT, servos)
    size = REQUEST + servos + servos * (ANSWER + PRESENT) + WRITE + servos * (GOAL + 1)
    size += 2 * (REQUEST + some) + some * (2 * ANSWER + WATCHED + MEASURED)
    size += (REQUEST + ANSWER + BOARD) if board else 0
    return size * BITS / baud + (servos + 2 * some + board) * return_delay


def _check_bus(robot: Robot, marks: Marks) -> None:
    n, tick = len(robot.joints), robot.dt
    board = robot.bus.board != "none"
    needs = cycle_seconds(n, robot.bus.baud, board=board)
    if needs <= BUS_SHARE * tick:
        return
    fast = next((baud for baud in BAUDS if cycle_seconds(n, baud, board=board) <= BUS_SHARE * tick), None)
    remedy = f"set {fast} or more" if fast else "lower the rate"
    raise marks.error(
        "bus.baud",
        f"at {robot.bus.baud} bit/s a control cycle of {n} servos takes {1000 * needs:.1f} ms on the wire, and a tick "
        f"at rate {robot.rate} has {1000 * tick:.1f}, of which {1000 * BUS_SHARE * tick:.1f} for the bus: {remedy}",
    )


def _check_speeds(robot: Robot, marks: Marks) -> None:
    slowest = min(robot.servos, key=lambda servo: servo.no_load_speed)
    limits, top = robot.limits, slowest.no_load_speed
    if limits.joint_speed > top:
        raise marks.error(
            "limits.joint_speed",
            f"{limits.joint_speed:g} rad/s is more than the {top:g} that a {slowest.name} turns at without a load; "
            "goals that no servo can follow would run ahead of it",
        )
    if limits.homing_speed > HOMING_SHARE * top:
        raise marks.error(
            "limits.homing_speed",
            f"{limits.homing_speed:g} rad/s is too fast to go home from any pose: at most {HOMING_SHARE * top:.2f}, a "
            f"quarter of what a {slowest.name} can (speeds are in rad/s, not degrees)",
        )
    if limits.homing_speed > limits.joint_speed:
        raise marks.error("limits.homing_speed", f"must not be above limits.joint_speed ({limits.joint_speed:g})")


def _check_protections(robot: Robot, marks: Marks) -> None:
    limits = robot.limits
    coolest = min(robot.servos, key=lambda servo: servo.max_temperature)
    if limits.temperature > coolest.max_temperature:
        raise marks.error(
            "limits.temperature",
            f"{limits.temperature:g} C is above the {coolest.max_temperature:g} at which a {coolest.name} shuts itself "
            "down: the robot would drop before it is lowered",
        )
    low = max(servo.voltage_range[0] for servo in robot.servos)
    high = min(servo.voltage_range[1] for servo in robot.servos)
    for name in ("voltage", "derate_voltage"):
        value = getattr(limits, name)
        if value is not None and not low <= value < high:
            raise marks.error(
                f"limits.{name}", f"{value:g} V is outside the {low:g} to {high:g} V that the servos work at"
            )


def _check_angles(robot: Robot, marks: Marks) -> None:
    limits = robot.limits
    if limits.tilt > math.pi / 2:
        raise marks.error(
            "limits.tilt", f"{limits.tilt:g} rad is more than lying down: the robot has fallen long before"
        )
    for i, joint in enumerate(robot.joints):
        if robot.extended[i] and joint.gear <= 1.0:
            raise marks.error(f"joints[{i}].range", f"{joint.name}: wider than the one turn that its servo has")


def check_geometry(robot: Robot, marks: Marks) -> None:
    """Raise ConfigError for what does not go with legs that were read from the MJCF."""
    limits = robot.limits
    falls = math.sqrt(robot.standing_height / GRAVITY)
    if limits.stale * robot.dt > falls:
        raise marks.error(
            "limits.stale",
            f"{limits.stale} ticks are {limits.stale * robot.dt:.2f} s, and a robot {robot.standing_height:g} m tall "
            f"topples in about {falls:.2f}: at most {int(falls / robot.dt)}",
        )
    reach = max(
        sum(math.hypot(*at) for at in (*(link.offset for link in leg), foot.body_place, foot.sole))
        for leg, foot in zip(robot.legs.values(), robot.feet.values(), strict=True)
    )
    if robot.standing_height > reach:
        raise marks.error(
            "standing_height", f"{robot.standing_height:g} m is more than its legs reach ({reach:.3f} m, in metres)"
        )
